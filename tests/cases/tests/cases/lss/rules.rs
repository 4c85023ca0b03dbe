//! The rules of LSS that a line breaks, each with cases that find it.

use canopen_node::Frame;

use super::{
    HONEST, Memory, NODE, RATE, Rule, START_US, answer, command, nmt, number, part, request,
    with_byte, with_number,
};

/// What a device does wrong, its line, and the cases that fail by that: `LSS states 3 5`.
pub const SABOTAGES: &[(&str, Rule, &str)] = &[
    to("04 00 is not obeyed", "LSS states 1", |_, frame| lost(frame, |data| data[..2] == [4, 0])),
    to("04 is answered", "LSS states 1 2", |memory, frame| {
        if command(&frame) == Some(0x04) {
            memory.answer(&[0x04]);
        }
        vec![frame]
    }),
    to("04 takes any mode by its lowest bit", "LSS states 2", |_, frame| match *frame.data() {
        [0x04, mode, ..] if command(&frame).is_some() => {
            vec![with_byte(frame, 1, mode & 1)]
        }
        _ => vec![frame],
    }),
    of(
        "A select has no answer",
        "LSS states 3 5 10, LSS unconfigured 5, LSS frames 6",
        |_, frame| no_answer(frame, 0x44),
    ),
    to("Every LSS address is its own", "LSS states 4, LSS several 2 3 4 5 6 7", |_, frame| {
        match command(&frame) {
            Some(select @ 0x40..=0x43) => vec![with_number(select, part(select, 0x40))],
            _ => vec![frame],
        }
    }),
    to("40 does not begin a select again", "LSS states 5", |memory, frame| match command(&frame) {
        Some(0x40) if memory.parts & 1 == 1 => vec![],
        Some(select @ 0x40..=0x43) => {
            memory.parts |= 1 << (select - 0x40);
            vec![frame]
        }
        _ => vec![frame],
    }),
    to("A select works in configuration too", "LSS states 6", |memory, frame| {
        match command(&frame) {
            Some(0x40) if memory.is_configuring => vec![request(&[4, 0]), frame],
            _ => vec![frame],
        }
    }),
    to("Each 43 is answered", "LSS states 4 6 14, LSS further 1 2 3 4 15", |memory, frame| {
        answered(memory, frame, 0x43, &[0x44])
    }),
    of(
        "5A to 5D are answered with another number",
        "LSS states 7, LSS Fastscan 4 5 6 11, LSS several 2 3 5, LSS further 14",
        |_, frame| match answer(&frame) {
            Some([0x5A..=0x5D, byte, ..]) => Some(with_byte(frame, 1, byte ^ 1)),
            _ => Some(frame),
        },
    ),
    of(
        "5E is answered with the pending node-ID",
        "LSS node-ID 4 7, LSS store 2",
        |memory, frame| match answer(&frame) {
            Some([0x5E, ..]) => {
                let pending = memory.numbers.get(&0x11).map(|number| *number as u8);
                Some(with_byte(frame, 1, pending.unwrap_or(9)))
            }
            _ => Some(frame),
        },
    ),
    of(
        "5E is answered with the next node-ID",
        "LSS states 8 10, LSS unconfigured 1",
        |memory, frame| match answer(&frame) {
            // What precedes the case goes on.
            Some([0x5E, id, ..]) if memory.requested_at < memory.now - 150 => {
                Some(with_byte(frame, 2, id))
            }
            _ => Some(frame),
        },
    ),
    to(
        "Waiting serves what configuration does",
        "LSS states 1 9, LSS frames 1 2 4",
        |memory, frame| match command(&frame) {
            Some(0x11..=0x17 | 0x5A..=0x5E) if !memory.is_configuring => {
                vec![request(&[4, 1]), frame, request(&[4, 0])]
            }
            _ => vec![frame],
        },
    ),
    to("LSS is not served in NMT state stopped", "LSS states 10", |memory, frame| {
        match command(&frame) {
            Some(_) if memory.is_stopped => vec![],
            _ => vec![frame],
        }
    }),
    to("NMT start, stop and enter pre-operational lead to waiting", "LSS states 11", |_, frame| {
        match frame.data() {
            [1 | 2 | 0x80, _] if frame.cob_id() == 0 => vec![frame, request(&[4, 0])],
            _ => vec![frame],
        }
    }),
    to("NMT resets lead to configuration", "LSS states 12 13", |_, frame| match frame.data() {
        [0x81 | 0x82, _] if frame.cob_id() == 0 => vec![frame, request(&[4, 1])],
        _ => vec![frame],
    }),
    of(
        "Identify remote slave has no answer",
        "LSS identify 1 2 3 4 7, LSS several 1, LSS further 5 6",
        |memory, frame| match memory.request[0] {
            0x4B => no_answer(frame, 0x4F),
            _ => Some(frame),
        },
    ),
    of(
        "Identify remote slave has no answer without a node-ID",
        "LSS identify 2",
        |memory, frame| match memory.node {
            None => no_answer(frame, 0x4F),
            _ => Some(frame),
        },
    ),
    to(
        "Each 4B is answered",
        "LSS identify 5 6 7 8 9, LSS several 1, LSS further 5 20",
        |memory, frame| answered(memory, frame, 0x4B, &[0x4F]),
    ),
    to("The bounds of identify have a sign", "LSS identify 3 4, LSS several 1", |memory, frame| {
        match command(&frame) {
            Some(high @ (0x49 | 0x4B)) => {
                let own = part(0x42 + (high - 0x49) / 2, 0x40) as i32;
                let low = memory.numbers.get(&(high - 1)).map_or(0, |low| *low as i32);
                let is_within = (low..=number(&frame) as i32).contains(&own);
                if is_within { vec![frame] } else { vec![] }
            }
            _ => vec![frame],
        }
    }),
    to(
        "The high bound of identify is no part of the range",
        "LSS identify 1 2 3 4 7, LSS several 1, LSS further 5",
        |_, frame| match command(&frame) {
            Some(high @ (0x49 | 0x4B)) => {
                vec![with_number(high, number(&frame).saturating_sub(1))]
            }
            _ => vec![frame],
        },
    ),
    to("The bounds of identify are taken in any order", "LSS identify 6", |memory, frame| {
        match command(&frame) {
            Some(0x48 | 0x4A) => vec![],
            Some(high @ (0x49 | 0x4B)) => {
                let low = memory.numbers.get(&(high - 1)).copied().unwrap_or(0);
                let (low, high_bound) = (low.min(number(&frame)), low.max(number(&frame)));
                vec![with_number(high - 1, low), with_number(high, high_bound)]
            }
            _ => vec![frame],
        }
    }),
    to("Identify does not compare vendor-ID and product code", "LSS identify 8", |_, frame| {
        match command(&frame) {
            Some(identify @ (0x46 | 0x47)) => {
                vec![with_number(identify, part(identify, 0x46))]
            }
            _ => vec![frame],
        }
    }),
    to("A range of revisions compares the minor part", "LSS further 6", |_, frame| {
        match command(&frame) {
            Some(0x49) if number(&frame) & 0xFFFF < part(0x42, 0x40) & 0xFFFF => vec![],
            _ => vec![frame],
        }
    }),
    of("4C has no answer", "LSS unconfigured 2, LSS several 6", |_, frame| no_answer(frame, 0x50)),
    to("Each 4C is answered", "LSS unconfigured 3 4, LSS several 6", |memory, frame| {
        answered(memory, frame, 0x4C, &[0x50])
    }),
    of(
        "The boot-up is that of the next node",
        "LSS unconfigured 5, LSS node-ID 3 5 6 7, LSS several 5 6 7, LSS bit rate 5 12",
        |_, frame| match (frame.cob_id(), frame.data()) {
            (cob_id @ 0x701..0x77F, [0]) => Frame::new(cob_id + 1, &[0]),
            _ => Some(frame),
        },
    ),
    to("A device without a node-ID has an SDO server", "LSS unconfigured 6", |memory, frame| {
        if frame.cob_id() == 0x605 && memory.node.is_none() {
            memory.add(300, 0x585, &[0x43, 0, 0x10, 0, 0, 0, 0, 0]);
        }
        vec![frame]
    }),
    of(
        "Fastscan has no answer",
        "LSS Fastscan 1 4 5 6 7 8 9 10 11 13 14, LSS several 2 5, LSS further 7 8",
        |memory, frame| match memory.request[0] {
            0x51 => no_answer(frame, 0x4F),
            _ => Some(frame),
        },
    ),
    to(
        "Each 51 is answered",
        "LSS Fastscan 2 3 4 6 7 8 9 10 12, LSS several 5, LSS further 8",
        |memory, frame| answered(memory, frame, 0x51, &[0x4F]),
    ),
    of(
        "11, 13 and 17 accept everything",
        "LSS node-ID 2 3, LSS bit rate 2 3 4, LSS store 4, LSS further 9 10",
        |_, frame| match answer(&frame) {
            Some([0x11 | 0x13 | 0x17, _, ..]) => Some(with_byte(frame, 1, 0)),
            _ => Some(frame),
        },
    ),
    (
        "A refused 11 takes node-ID 127, a refused 13 the stored bit rate",
        Rule {
            to_device: |_, frame| match *frame.data() {
                [0x11, 0 | 0x80..=0xFE, ..] => vec![request(&[0x11, 0x7F])],
                [0x13, 0, 5, ..] => vec![request(&[0x13, 0, RATE.index()])],
                _ => vec![frame],
            },
            of_device: |memory, frame| match (answer(&frame), memory.request) {
                (Some([0x11, ..]), [_, 0 | 0x80..=0xFE, ..]) => Some(with_byte(frame, 1, 1)),
                (Some([0x13, ..]), [_, 0, 5, ..]) => Some(with_byte(frame, 1, 1)),
                _ => Some(frame),
            },
            ..HONEST
        },
        "LSS node-ID 3, LSS further 10",
    ),
    of("11 refuses 100, and 13 has no answer", "LSS node-ID 1, LSS bit rate 1", |memory, frame| {
        match (answer(&frame), memory.request[1]) {
            (Some([0x11, ..]), 100) => Some(with_byte(frame, 1, 1)),
            _ => no_answer(frame, 0x13),
        }
    }),
    to("04 00 makes any pending node-ID active", "LSS node-ID 6", |memory, frame| {
        match frame.data() {
            [0x04, 0, ..] if memory.numbers.contains_key(&0x11) && memory.node.is_some() => {
                vec![frame, nmt(0x82)]
            }
            _ => vec![frame],
        }
    }),
    to("Node-ID 255 is no node-ID to take", "LSS node-ID 8 14", |memory, frame| {
        match frame.data() {
            [0x11, 0xFF, ..] if memory.is_configuring => vec![request(&[0x11, NODE])],
            _ => vec![frame],
        }
    }),
    (
        "The SDO server keeps the COB-IDs of the first node-ID",
        Rule {
            to_device: |memory, frame| match (frame.cob_id(), memory.node) {
                (0x605, Some(node)) => {
                    Frame::new(0x600 + u16::from(node), frame.data()).into_iter().collect()
                }
                _ => vec![frame],
            },
            of_device: |_, frame| match frame.cob_id() {
                0x580..0x600 => Frame::new(0x585, frame.data()),
                _ => Some(frame),
            },
            ..HONEST
        },
        "LSS node-ID 9",
    ),
    to(
        "Reset node does what reset communication does",
        "LSS node-ID 10, LSS bit rate 13",
        |_, frame| match frame.data() {
            [0x81, _] if frame.cob_id() == 0 => vec![nmt(0x82)],
            _ => vec![frame],
        },
    ),
    to(
        "Reset communication does what reset node does",
        "LSS node-ID 3 5 6, LSS bit rate 12",
        |_, frame| match frame.data() {
            [0x82, _] if frame.cob_id() == 0 => vec![nmt(0x81)],
            _ => vec![frame],
        },
    ),
    to(
        "17 stores nothing, and says that it did",
        "LSS node-ID 11 12 14, LSS store 3 4 5 6",
        |memory, frame| match command(&frame) {
            Some(0x17) if memory.is_configuring => answered(memory, frame, 0x17, &[0x17])
                .into_iter()
                .filter(|frame| command(frame).is_none())
                .collect(),
            _ => vec![frame],
        },
    ),
    (
        "11 stores",
        Rule {
            to_device: |memory, frame| match command(&frame) {
                Some(0x11) if memory.is_configuring => vec![frame, request(&[0x17])],
                _ => vec![frame],
            },
            of_device: |memory, frame| match (answer(&frame), memory.request[0]) {
                // It answers when it has stored.
                (Some([0x17, ..]), 0x11) => Some(with_byte(frame, 0, 0x11)),
                _ => no_answer(frame, 0x11),
            },
            ..HONEST
        },
        "LSS node-ID 10 13",
    ),
    of(
        "17 has no answer",
        "LSS node-ID 11 12 14, LSS store 1 2 3 4 5 6, LSS further 17",
        |_, frame| no_answer(frame, 0x17),
    ),
    to("17 makes the pending node-ID active", "LSS store 2", |_, frame| match command(&frame) {
        Some(0x17) => vec![frame, nmt(0x82), request(&[4, 1])],
        _ => vec![frame],
    }),
    of("13 acts at once", "LSS bit rate 5", |memory, frame| match memory.other_rate {
        Some(_) if memory.request[0] != 0x13 => None,
        _ => Some(frame),
    }),
    to("The delay of 15 is 5 ms longer", "LSS bit rate 6 7 8", |_, frame| match *frame.data() {
        [0x15, low, high, ..] => {
            let delay = u16::from_le_bytes([low, high]).saturating_add(5).to_le_bytes();
            vec![request(&[0x15, delay[0], delay[1]])]
        }
        _ => vec![frame],
    }),
    to("The delay of 15 is 5 ms shorter", "LSS bit rate 6 7 9", |_, frame| match *frame.data() {
        [0x15, low, high, ..] => {
            let delay = u16::from_le_bytes([low, high]).saturating_sub(5).to_le_bytes();
            vec![request(&[0x15, delay[0], delay[1]])]
        }
        _ => vec![frame],
    }),
    to(
        "15 is not obeyed",
        "LSS bit rate 6 7 8 9 11 12, LSS several 8, LSS further 10 11",
        |_, frame| lost(frame, |data| data[0] == 0x15),
    ),
    to("A boot-up in both delays of 15 and after them", "LSS bit rate 10 11", |memory, frame| {
        if command(&frame) == Some(0x15) {
            memory.add(20_000, 0x705, &[0]);
            memory.add(150_000, 0x705, &[0]);
        }
        vec![frame]
    }),
    to("Requests in both delays are answered", "LSS further 11 12", |memory, frame| match command(
        &frame,
    ) {
        Some(0x5E) if memory.request[0] == 0x15 => answered(memory, frame, 0x5E, &[0x5E, NODE]),
        _ => vec![frame],
    }),
    (
        "Short requests, other COB-IDs, remote and extended frames are requests",
        Rule {
            to_device: |_, frame| match frame.cob_id() {
                0x7E4..=0x7ED | 0x7C5 | 0x5E5 => vec![request(frame.data())],
                _ => vec![frame],
            },
            takes_all: true,
            ..HONEST
        },
        "LSS frames 1 2 3 4",
    ),
    to("The highest bit of a command specifier does not count", "LSS frames 5", |_, frame| {
        match command(&frame) {
            Some(command) => vec![with_byte(frame, 0, command & 0x7F)],
            _ => vec![frame],
        }
    }),
    of("Reserved bytes are repeated in the answer", "LSS frames 6", |memory, frame| {
        match answer(&frame) {
            Some([0x44 | 0x11 | 0x13 | 0x5E, ..]) => Some(with_byte(frame, 7, memory.request[7])),
            _ => Some(frame),
        }
    }),
    of("Each answer comes twice", "LSS several 3 4, LSS further 14 15 16", |memory, frame| {
        if let Some(bytes) = answer(&frame) {
            memory.answer(&bytes);
        }
        Some(frame)
    }),
    to("A request right behind another is lost", "LSS further 4 14 15 16 17", |memory, frame| {
        match command(&frame) {
            Some(_) if memory.now < memory.requested_at + 1_000 && memory.now > START_US => {
                vec![]
            }
            _ => vec![frame],
        }
    }),
    to("The steps of a select count in any order", "LSS further 1", |memory, frame| match command(
        &frame,
    ) {
        Some(select @ 0x40..=0x43) => {
            memory.parts |= 1 << (select - 0x40);
            if memory.parts != 0b1111 {
                return vec![frame];
            }
            memory.parts = 0;
            (0x40..=0x43).map(|select| with_number(select, part(select, 0x40))).collect()
        }
        _ => vec![frame],
    }),
    of("A refused 13 has error code 2", "LSS further 9", |_, frame| match answer(&frame) {
        Some([0x13, 1, ..]) => Some(with_byte(frame, 1, 2)),
        _ => Some(frame),
    }),
    to("NMT resets are not for a device without a node-ID", "LSS further 13", |memory, frame| {
        match frame.cob_id() {
            0 if memory.node.is_none() => vec![],
            _ => vec![frame],
        }
    }),
    ("An answer takes 5 ms", Rule { answer_us: 5_000, ..HONEST }, "LSS further 18"),
];

/// A line that does this with the frames for the devices.
const fn to(
    what: &'static str,
    found_by: &'static str,
    to_device: fn(&mut Memory, Frame) -> Vec<Frame>,
) -> (&'static str, Rule, &'static str) {
    (what, Rule { to_device, ..HONEST }, found_by)
}

/// A line that does this with their frames.
const fn of(
    what: &'static str,
    found_by: &'static str,
    of_device: fn(&mut Memory, Frame) -> Option<Frame>,
) -> (&'static str, Rule, &'static str) {
    (what, Rule { of_device, ..HONEST }, found_by)
}

/// Loses a request that `is_it`.
fn lost(frame: Frame, is_it: fn(&[u8]) -> bool) -> Vec<Frame> {
    if command(&frame).is_some() && is_it(frame.data()) { vec![] } else { vec![frame] }
}

/// Loses an answer with this command specifier.
fn no_answer(frame: Frame, command: u8) -> Option<Frame> {
    let is_it = answer(&frame).is_some_and(|answer| answer[0] == command);
    (!is_it).then_some(frame)
}

/// Answers each request with this command specifier.
fn answered(memory: &mut Memory, frame: Frame, specifier: u8, bytes: &[u8]) -> Vec<Frame> {
    if command(&frame) == Some(specifier) {
        memory.answer(bytes);
    }
    vec![frame]
}
