//! The digest of a node: equal for two nodes that behave alike from now on.

use std::{
    fmt::Write,
    hash::{DefaultHasher, Hasher},
};

use canopen_node::{Instant, Node};

/// No rule of the node looks back further than this many microseconds.
const PAST: i32 = 3_000_000;
/// The rounding of times, in microseconds: those further away than the first number are rounded up to a multiple of the
/// second. The checker goes on from one of two states that differ less.
const ROUNDED: [(i32, i32); 2] = [(3_000_000, 10_000_000), (150_000, 500_000)];
/// What has no effect on the behaviour, from a text to the next of a character: counters and the error history 1003h,
/// which only objects of the dictionary show, the time of no heartbeat, and that of no SDO transfer: the model has none.
const WITHOUT_EFFECT: [(&str, char); 6] = [
    ("rescues: ", ','),
    ("history: [", ']'),
    ("bus_offs: ", ','),
    ("overruns: ", ','),
    ("period_ms: 0, ", ','),
    ("since: ", ','),
];
/// What has an effect only away from home: leaving home sets it anew.
const AWAY: [&str; 6] =
    [" errors: ", "found: ", "has_moved: ", "heard_at: ", "is_in_session: ", "is_asked: "];
/// More errors than this in succession have no other effect on the supervision.
const MANY_ERRORS: u32 = 2;

/// The digest of a node at `now`: of its state as `Debug` shows it, with instants relative to `now`.
pub fn digest(node: &Node, now: Instant) -> u64 {
    let mut text = String::with_capacity(4096);
    write!(text, "{node:?}").expect("a string takes all");
    let mut hasher = DefaultHasher::new();
    hasher.write(relative(&text, now).as_bytes());
    hasher.finish()
}

pub fn relative(text: &str, now: Instant) -> String {
    let mut relative = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = rest.find("Instant(") {
        let (before, number) = rest.split_at(at + "Instant(".len());
        let end = number.find(')').expect("a number in parentheses");
        let micros: u32 = number[..end].parse().expect("a number");
        let ahead = micros.wrapping_sub(now.as_micros()).cast_signed().max(-PAST);
        let ahead = match ROUNDED.into_iter().find(|(from, _)| ahead.abs() > *from) {
            Some((_, multiple)) => ahead.div_euclid(multiple) * multiple + multiple,
            None => ahead,
        };
        write!(relative, "{before}{ahead}").expect("a string takes all");
        rest = &number[end..];
    }
    relative.push_str(rest);
    for (name, end) in WITHOUT_EFFECT {
        replace(&mut relative, name, end, |_| String::new());
    }
    // The agenda keeps the deadlines of tasks that have none any more.
    let mut timed = 0;
    replace(&mut relative, "timed: Tasks(", ')', |tasks| {
        timed = tasks.parse::<u32>().expect("a set of tasks");
        tasks.to_owned()
    });
    replace(&mut relative, "deadlines: [", ']', |deadlines| {
        let of_tasks = deadlines.split(", ").enumerate();
        of_tasks.filter(|(task, _)| timed >> task & 1 == 1).map(|(_, deadline)| deadline).collect()
    });
    if relative.contains("place: Home") {
        for name in AWAY {
            replace(&mut relative, name, ',', |_| String::new());
        }
    }
    replace(&mut relative, " errors: ", ',', |count| match count.parse() {
        Ok(count) => MANY_ERRORS.min(count).to_string(),
        Err(_) => count.to_string(),
    });
    relative
}

/// Replaces what follows each `name`, up to the next `end`.
fn replace(text: &mut String, name: &str, end: char, mut with: impl FnMut(&str) -> String) {
    let mut at = 0;
    while let Some(found) = text[at..].find(name) {
        at += found + name.len();
        let Some(len) = text[at..].find(end) else { return };
        let new = with(&text[at..at + len]);
        text.replace_range(at..at + len, &new);
    }
}

#[cfg(test)]
mod tests {
    use testkit::{
        frames::request,
        node_rig::{ADDRESS, device},
    };

    use super::*;

    /// The digest of a node in a switch that began at `micros`, 1 ms later.
    fn switching(micros: u32, request_of_switch: &str) -> u64 {
        let mut node = Node::new(device(ADDRESS).with_rescue(true), None);
        let at = |ms: u32| Instant::from_micros(micros).plus_micros(ms * 1000);
        while node.poll(at(0)).is_some() {}
        for text in ["04 01", request_of_switch] {
            while node.handle_frame(&request(text), at(0)).or_else(|| node.poll(at(0))).is_some() {}
        }
        digest(&node, at(1))
    }

    #[test]
    fn the_same_situation_at_another_time_has_the_same_digest() {
        assert_eq!(switching(0, "15 0A 00"), switching(u32::MAX - 500, "15 0A 00"));
        assert_ne!(switching(0, "15 0A 00"), switching(0, "15 0B 00"));
    }
}
