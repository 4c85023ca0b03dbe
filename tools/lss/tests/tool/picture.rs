//! The picture of a run: `--svg`.

use std::fs;

use canopen_node::BitRate;
use emulator::network::Source;
use testkit::cargo;

use crate::{
    assign::{entry, file},
    emulated::{Boards, address_text},
};

const RATE: BitRate = BitRate::Kbit125;
/// More than the width of a character of the size 12.
const CHARACTER: f64 = 6.9;

/// The picture of a command, in which no text overlaps another or leaves the picture.
#[track_caller]
fn svg(boards: &Boards, name: &str, arguments: &str) -> String {
    let path = cargo::scratch(name);
    boards.lss(&format!("{arguments} --svg {}", path.display()));
    let svg = fs::read_to_string(path).expect("a picture");
    // A browser shrinks one without a size to its window.
    assert!(svg.contains("width=\"1200\" height=\""), "{svg:.200}");
    let texts = texts(&svg);
    for (number, (x, y, text)) in texts.iter().enumerate() {
        let end = x + CHARACTER * text.chars().count() as f64;
        assert!(*x >= 0.0 && end < 1240.0, "{text} at {x} leaves the picture");
        for (other_x, other_y, other) in &texts[..number] {
            let is_apart = (y - other_y).abs() > 11.0
                || end <= *other_x
                || other_x + CHARACTER * other.chars().count() as f64 <= *x;
            assert!(is_apart, "{text} is over {other}");
        }
    }
    svg
}

/// The texts, with their left ends and their base lines.
fn texts(svg: &str) -> Vec<(f64, f64, String)> {
    let elements = svg.split("<text ").skip(1);
    let texts = elements.map(|element| {
        let (attributes, rest) = element.split_once('>').expect("an element");
        let text = rest.split_once("</text>").expect("its end").0.to_owned();
        let value = |name: &str| {
            let value = attributes.split(&format!("{name}=\"")).nth(1);
            value.and_then(|rest| rest.split('"').next())
        };
        let number = |name| value(name).and_then(|text| text.parse().ok()).expect("a number");
        let width = CHARACTER * text.chars().count() as f64;
        let left: f64 = match value(" text-anchor") {
            Some("middle") => number("x") - width / 2.0,
            _ => number("x"),
        };
        (left.max(0.0), number(" y"), text)
    });
    texts.collect()
}

/// How often a step occurs.
fn count(svg: &str, words: &str) -> usize {
    svg.matches(&format!(" s: {words}")).count()
}

#[test]
fn an_assignment_shows_who_got_what_and_when() {
    for others in [2, 19] {
        let mut ids = vec![0xFF; others];
        ids.push(2);
        let boards = Boards::new(RATE, &ids);
        let svg = svg(&boards, "assign.svg", "assign");
        assert!(svg.contains(">lss assign</text>") && svg.contains(">125 kbit/s</text>"));
        for board in 0..others {
            assert!(svg.contains(&format!(">{}</text>", address_text(board))));
        }
        assert_eq!(svg.matches(">before: no node-ID</text>").count(), others);
        assert_eq!(svg.matches(", stored</text>").count(), others);
        assert!(svg.contains(">got node-ID 1, stored</text>"));
        assert!(svg.contains(">node-ID 2 as before</text>"));
        assert!(svg.contains(&format!(">got node-ID {}, stored</text>", others + 1)));
        assert_eq!(count(&svg, "found by Fastscan, "), others);
        assert_eq!(count(&svg, "node-ID "), others);
        assert_eq!(count(&svg, "stored"), others);
        // One at the end of LSS configuration state, one after the reset.
        assert_eq!(count(&svg, "boots up as node "), 2 * others);
        assert_eq!(count(&svg, "NMT reset node"), others);
        assert!(!svg.contains(">no answer to "));
    }
}

#[test]
fn a_missing_board_and_one_that_does_not_come_back_are_red() {
    let boards = Boards::new(RATE, &[0xFF, 30]);
    let path = file("picture.toml", entry(5, 0) + &entry(6, 7).replace("4C535334", "1"));
    boards.after(20, |network| (0..2).for_each(|board| network.power_off(board)));
    boards.after(25, |network| network.power_on(1));
    let arguments = format!("assign --power-check --table {}", path.display());
    let svg = svg(&boards, "missing.svg", &arguments);
    assert_eq!(svg.matches(">no answer by SDO</text>").count(), 1, "node 5");
    let silent = ">no answer to switch state selective</text>";
    assert_eq!(svg.matches(silent).count(), 1, "that of the table");
    assert!(svg.contains(">node 6 of the table is missing: "));
    assert!(svg.contains(">node 5 has not come back within 30 s: "));
    // The waits are shortened.
    let silences: Vec<&str> = svg.split(" s without a request</title>").collect();
    assert!(silences.len() > 1);
    for before in &silences[..silences.len() - 1] {
        let seconds = before.rsplit('>').next().and_then(|text| text.parse::<f64>().ok());
        let text = format!(">{:.0} s</text>", seconds.expect("a number"));
        assert!(svg.contains(&text), "{text}");
    }
}

#[test]
fn a_switch_shows_the_bit_rates_and_the_way_back() {
    let boards = Boards::new(RATE, &[1, 2, 3]);
    let there = svg(&boards, "rate.svg", "set-rate 500");
    assert!(there.contains(">lss set-rate 500</text>"));
    assert_eq!(there.matches(" as before, 500 kbit/s, stored</text>").count(), 3);
    assert_eq!(count(&there, "all switch, with a delay of 500 ms"), 1);

    let boards = Boards::new(RATE, &[1, 2, 3]);
    boards.at_each_frame(|frame, network| {
        if frame.cob_id() == 0x7E5 && frame.data().first() == Some(&0x15) {
            network.cut_wire(Source::Board(1));
        }
    });
    let back = svg(&boards, "back.svg", "set-rate 500");
    assert_eq!(back.matches(" as before, 125 kbit/s</text>").count(), 2);
    assert_eq!(back.matches(">no answer to switch state selective</text>").count(), 1);
    assert_eq!(count(&back, "all switch, with a delay of 500 ms"), 2);
    assert!(back.contains(">at 500 kbit/s: board "));
}

#[test]
fn words_that_are_too_long_for_the_picture_are_cut() {
    let boards = Boards::new(RATE, &[1]);
    boards.unsupported.set(Some(0x13));
    let svg = svg(&boards, "long.svg", "set-rate 500");
    assert_eq!(svg.matches(">no answer to configure bit timing: 125 kbi…</text>").count(), 1);
    assert!(count(&svg, "no answer to configure bit timing: 125 kbit/s (table 0, index 4)") > 0);
}

#[test]
fn a_picture_that_cannot_be_written_is_told_before_anything_happens() {
    let boards = Boards::new(RATE, &[0xFF]);
    let outcome = boards.lss("assign --svg /nowhere/picture.svg");
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.starts_with("cannot write /nowhere/picture.svg: "), "{}", outcome.error);
    assert_eq!(boards.stored(0), None);
}
