//! The cases of CiA 301 on a node in the process: all hold, and with a line that breaks a rule, or with a wrong data
//! sheet, those that prove it fail.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use crate::{has_failed, numbers};
use can_bus::{
    adapter::{Adapter, Mode, Received},
    stop::Stop,
};
use canopen_node::{Action, BitRate, Frame, Node};
use conformance::{APPLICATION_LAYER, Bench, Group, Line, OWN, Outcome, Report, eds::Eds};
use example_io::application::Application;
use testkit::{
    eds::{DataSheet, Product},
    flash::BoardFlash,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    random::Random,
};

const NODE: u8 = 0x40;

/// What a line makes of a frame; `None`: it is lost.
type Change = fn(Frame) -> Option<Frame>;

/// The node, on a line that changes frames to it and from it.
struct Saboteur {
    rig: NodeRig<Application>,
    to_node: Change,
    of_node: Change,
    received: VecDeque<Received>,
    start: Instant,
}

impl Saboteur {
    fn take_sent(&mut self) {
        for (us, action) in self.rig.take_timed_actions() {
            if let Action::Transmit(frame, _) = action
                && let Some(frame) = (self.of_node)(frame)
            {
                let at = Duration::from_micros(us);
                self.received.push_back(Received { frame, at, here: self.start + at });
            }
        }
    }
}

impl Adapter for Saboteur {
    fn open(&mut self, _: BitRate, _: Mode) -> Result<(), Stop> {
        Ok(())
    }

    fn close(&mut self) -> Result<(), Stop> {
        Ok(())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Stop> {
        if let Some(frame) = (self.to_node)(*frame) {
            self.rig.receive(&frame);
            self.take_sent();
        }
        Ok(())
    }

    fn receive(&mut self, wait: Duration) -> Result<Option<Received>, Stop> {
        let until = self.now() + wait;
        while self.received.is_empty() && self.now() < until {
            let left = (until - self.now()).as_micros() as u64;
            let next = self.rig.us_to_deadline().unwrap_or(left);
            self.rig.pass_us(left.min(next).max(1));
            self.take_sent();
        }
        Ok(self.received.pop_front())
    }

    fn now(&self) -> Instant {
        self.start + Duration::from_micros(self.rig.now())
    }

    fn description(&self) -> String {
        String::new()
    }
}

/// The data sheet of the node.
fn right_sheet() -> String {
    let device = device(ADDRESS).with_defaults(defaults(NODE));
    let product = Product { file_name: "io.eds", vendor_name: "", description: "", device };
    let entries = Node::<Application>::entries(&device);
    DataSheet::new(product, entries, &Application::new()).eds()
}

/// Runs the cases that begin with one of `wanted` by this data sheet; returns the numbers and the outcomes.
fn outcomes(
    sheet: &str,
    wanted: &[&str],
    to_node: Change,
    of_node: Change,
) -> Vec<(String, Outcome)> {
    let device = device(ADDRESS).with_defaults(defaults(NODE));
    let eds = Eds::parse(sheet);
    let rig = NodeRig::with_application(device, BoardFlash::blank(0), 0, Application::new());
    let received = VecDeque::new();
    let mut line = Saboteur { rig, to_node, of_node, received, start: Instant::now() };
    let mut bench = Bench::new(Line::Adapter(&mut line), &eds, NODE);
    let mut report = Report::new("node");
    let wanted: Vec<_> = wanted.iter().map(|case| (*case).to_owned()).collect();
    // A device that never boots up ends the run early.
    let groups: Vec<Group> = [APPLICATION_LAYER, OWN].concat();
    let _ = conformance::run(&mut bench, &groups, &wanted, &mut report, |_| ());
    report.findings.into_iter().map(|finding| (finding.number, finding.outcome)).collect()
}

/// The numbers of the cases that fail, and not only what precedes them.
fn failed(outcomes: Vec<(String, Outcome)>) -> Vec<String> {
    let failed = outcomes.into_iter().filter(|(_, outcome)| has_failed(outcome));
    failed.map(|(number, _)| number).collect()
}

/// Runs the cases that begin with one of `wanted`; returns the numbers of those that fail.
fn failures(wanted: &[&str], to_node: Change, of_node: Change) -> Vec<String> {
    failed(outcomes(&right_sheet(), wanted, to_node, of_node))
}

fn unchanged(frame: Frame) -> Option<Frame> {
    Some(frame)
}

/// The frame with another byte at a place.
fn with_byte(frame: Frame, place: usize, byte: u8) -> Option<Frame> {
    let mut data = frame.data().to_vec();
    data[place] = byte;
    Frame::new(frame.cob_id(), &data)
}

/// What is wrong, the cases that fail by it, such as `SDO 3 5, PDO 23`, and what the line makes of frames to the node and
/// from it.
type Sabotage = (&'static str, &'static str, Change, Change);

/// A line that does this with frames to the node.
const fn to_node(rule: &'static str, found_by: &'static str, change: Change) -> Sabotage {
    (rule, found_by, change, unchanged)
}

/// A line that does this with those from it.
const fn of_node(rule: &'static str, found_by: &'static str, change: Change) -> Sabotage {
    (rule, found_by, unchanged, change)
}

const SABOTAGES: &[Sabotage] = &[
    of_node(
        "abort codes",
        "SDO 3 4 5 6 7 8 9 10 11 17 26 27 28, PDO 23 24 25 26 28 29 31 32, OD 3 4 6, Emergency 3, \
         Synchronization 5 9, Heartbeat 4, Testing other 1 3 5 7 10, Own 9 15, \
         Own SDO 3 4 5 6 8 9 13 16, Own PDO 7 10",
        |frame| match frame.data() {
            [0x80, ..] if is_of_server(&frame) => with_byte(frame, 7, 0x07),
            _ => Some(frame),
        },
    ),
    of_node("values of four bytes", "SDO 12 19, Emergency 1 6, Synchronization 1", |frame| {
        match *frame.data() {
            [0x43, _, _, _, byte, ..] if is_of_server(&frame) => with_byte(frame, 4, byte ^ 1),
            _ => Some(frame),
        }
    }),
    of_node(
        "the number of bytes in an answer",
        "SDO 1 13 19, OD 1 2 6 7 8 9",
        |frame| match *frame.data() {
            [0x43, 0x00, 0x10 | 0x21, 0, ..] if is_of_server(&frame) => with_byte(frame, 0, 0x47),
            [0x4F, 0x00, 0x21, 0, ..] if is_of_server(&frame) => with_byte(frame, 0, 0x4B),
            _ => Some(frame),
        },
    ),
    of_node("the toggle bit of an upload", "SDO 16 18 22 23", |frame| match *frame.data() {
        [byte @ 0..0x20, ..] if is_of_server(&frame) => with_byte(frame, 0, byte ^ 0x10),
        _ => Some(frame),
    }),
    of_node("the toggle bit of a download", "SDO 15", |frame| match *frame.data() {
        [byte @ (0x20 | 0x30), ..] if is_of_server(&frame) => with_byte(frame, 0, byte ^ 0x10),
        _ => Some(frame),
    }),
    of_node("the CRC of an upload", "SDO 19 22 23, Own 13, Own SDO 10", |frame| {
        match *frame.data() {
            [command, byte, ..] if is_of_server(&frame) && command & 0xE3 == 0xC1 => {
                with_byte(frame, 1, byte ^ 1)
            }
            _ => Some(frame),
        }
    }),
    to_node("the CRC of a download", "SDO 25, Own 14 15", |frame| match *frame.data() {
        [command, byte, ..] if is_to_server(&frame) && command & 0xE3 == 0xC1 => {
            with_byte(frame, 1, byte ^ 1)
        }
        _ => Some(frame),
    }),
    of_node("the confirmation of a block", "SDO 21 25, Own 14 15, Own SDO 14 15", |frame| {
        match *frame.data() {
            [0xA2, ..] if is_of_server(&frame) => with_byte(frame, 1, 3),
            _ => Some(frame),
        }
    }),
    of_node(
        "values that can be written",
        "SDO 2 15, PDO 4 5 6 7 8 10 11 12 13 14 16 17 18 19 20 22 23 25 26 27 28 29 30 31 32 33, \
         OD 1 6 7 9, Synchronization 2 3 4 5 6 7 8 9 10, Heartbeat 1 2 3 4 5 6 7",
        |frame| match frame.data() {
            // 1011h precedes each case.
            [0x60, 0x11, 0x10, ..] => Some(frame),
            [0x60, ..] if is_of_server(&frame) => aborted(frame),
            _ => Some(frame),
        },
    ),
    of_node("COB-IDs of PDOs", "PDO 1 2 4 5 6 7 8 10 11 12 13 14 16 17 18 19 20 22", |frame| {
        match frame.data() {
            [0x43, _, 0x14 | 0x18, 1, ..] => with_byte(with_byte(frame, 4, 0)?, 5, 0),
            _ => Some(frame),
        }
    }),
    // The writes become reads, and the answers confirm writes.
    (
        "1010h and 1011h",
        "Synchronization 10, Testing other 1 2 3 4 5 6 7 8 9",
        |frame| match frame.data() {
            [0x23, 0x10 | 0x11, 0x10, ..] if is_to_server(&frame) => with_byte(frame, 0, 0x40),
            _ => Some(frame),
        },
        |frame| match frame.data() {
            [0x43, 0x10 | 0x11, 0x10, ..] if is_of_server(&frame) => with_byte(frame, 0, 0x60),
            _ => Some(frame),
        },
    ),
    of_node(
        "heartbeats",
        "Heartbeat 2 7, State 1 2 3 4, Transition 1 2 3 4, Own 10 11 12, Own NMT 1 4 6, Own PDO 12",
        |frame| (frame.data() == [0] || frame.cob_id() != 0x740).then_some(frame),
    ),
    to_node("the end of the heartbeat", "Heartbeat 3", |frame| match frame.data() {
        [0x2B, 0x17, 0x10, 0, 0, 0, ..] => with_byte(frame, 4, 100),
        _ => Some(frame),
    }),
    // 232 ms in place of a second.
    to_node("the time of a watched heartbeat", "Heartbeat 5 7, Own 10 11, Own NMT 3", |frame| {
        match frame.data() {
            [0x23, 0x16, 0x10, ..] => with_byte(frame, 5, 0),
            _ => Some(frame),
        }
    }),
    of_node(
        "TPDOs",
        "PDO 4 5 6 7 8, Synchronization 3, State 3, Own 1 2 6, Own PDO 8 9 12",
        |frame| (!is_tpdo(&frame)).then_some(frame),
    ),
    of_node("the length of a TPDO", "Own 1", |frame| match is_tpdo(&frame) {
        true => Frame::new(frame.cob_id(), &frame.padded_data()),
        false => Some(frame),
    }),
    of_node(
        "emergency messages",
        "Emergency 4 5 6, Heartbeat 6 7, Own 3 7 10, Own NMT 2 3 5 6 7, Own PDO 3 4 5 6 11",
        |frame| (frame.cob_id() != 0xC0).then_some(frame),
    ),
    of_node("the error register", "Emergency 2 5, Own 8, Own NMT 2", |frame| match *frame.data() {
        [0x4F, 0x01, 0x10, 0, byte, ..] => with_byte(frame, 4, if byte == 0 { 1 } else { 0 }),
        _ => Some(frame),
    }),
    // Whatever the command but a reset, the node starts.
    to_node(
        "NMT commands",
        "PDO 10 11 12 13 14 16 17 18 19 20, State 2 4, Transition 2 3 4, Own NMT 1 5, Own SDO 18, Own PDO 1 11",
        |frame| match frame.data() {
            [1 | 2 | 0x80, _] if frame.cob_id() == 0 => with_byte(frame, 0, 1),
            _ => Some(frame),
        },
    ),
    of_node("entries of more than 64 bits: refused before", "PDO 25 26", |frame| {
        match frame.data() {
            [0x60, _, 0x16, 2, ..] => aborted(frame),
            _ => Some(frame),
        }
    }),
    of_node("entries of more than 64 bits: taken by an RPDO", "PDO 24 25 26", |frame| match frame
        .data()
    {
        [0x80, _, 0x16, 0, ..] => with_byte(frame, 0, 0x60),
        _ => Some(frame),
    }),
    // A TPDO of type 254 with an event timer of 512 ms: one comes in each pause between two SYNCs.
    to_node("synchronous TPDOs: the timer sends them", "PDO 6 7 8", |frame| match frame.data() {
        [0x2F, _, 0x18, 2, 0 | 1, ..] => with_byte(frame, 4, 254),
        [0x2B, _, 0x18, 5, 0, 0, ..] => with_byte(frame, 5, 2),
        _ => Some(frame),
    }),
    // From 780h on the node gets an allowed number.
    to_node("restricted COB-IDs with the valid bit", "Testing other 10", |frame| {
        match frame.data() {
            [0x23, 0x00, 0x18, 1, 0x80..=0xFF, 7, _, 0..0x80] => with_byte(frame, 5, 3),
            _ => Some(frame),
        }
    }),
    // The inhibit times and windows are 0, PDOs are not synchronous, RPDOs have no event timer.
    to_node("times of PDOs, SYNC and emergency messages", "Own 2 3 5 7, Own PDO 8 11", |frame| {
        match frame.data() {
            [0x2B, _, 0x18, 3, ..] | [0x2B, _, 0x14, 5, ..] | [0x2B, 0x15, 0x10, ..] => {
                with_byte(with_byte(frame, 4, 0)?, 5, 0)
            }
            [0x23, 0x07, 0x10, ..] => with_byte(with_byte(frame, 5, 0)?, 6, 0),
            _ => Some(frame),
        }
    }),
    of_node("1017h as a client reads it", "Own SDO 1 4 7 8 14 15 16 17 18", |frame| {
        match *frame.data() {
            [0x4B, 0x17, 0x10, 0, byte, ..] => with_byte(frame, 4, byte ^ 1),
            _ => Some(frame),
        }
    }),
    to_node(
        "short requests, the threshold and the block size of a block upload",
        "Own SDO 2 11 12",
        |frame| match *frame.data() {
            [0xA0, _, _, _, _, 1..=0xFF, ..] => with_byte(frame, 5, 0),
            [0xA2, _, 2, ..] => with_byte(frame, 2, 1),
            [0x40, ..] => Frame::new(frame.cob_id(), &frame.padded_data()),
            _ => Some(frame),
        },
    ),
    of_node("the unused bytes of a block upload", "Own SDO 10", |frame| match *frame.data() {
        [command, ..] if is_of_server(&frame) && command & 0xE3 == 0xC1 => {
            with_byte(frame, 0, command ^ 4)
        }
        _ => Some(frame),
    }),
    to_node("RPDOs at another COB-ID", "Own PDO 2", |frame| {
        (frame.cob_id() != 0x540).then_some(frame)
    }),
    to_node(
        "synchronous RPDOs, the counter of SYNC, 1014h, 1029h",
        "Own 4 5 6 8 10 11, Own NMT 6, Own PDO 1 5",
        |frame| match frame.data() {
            [0x2F, _, 0x14, 2, 0, ..] => with_byte(frame, 4, 255),
            [0x2F, 0x19 | 0x29, 0x10, ..] => with_byte(frame, 4, 0),
            [0x23, 0x14, 0x10, ..] => with_byte(frame, 7, 0),
            _ => Some(frame),
        },
    ),
];

fn is_to_server(frame: &Frame) -> bool {
    frame.cob_id() == 0x640
}

fn is_of_server(frame: &Frame) -> bool {
    frame.cob_id() == 0x5C0
}

fn is_tpdo(frame: &Frame) -> bool {
    (0x180..0x580).contains(&frame.cob_id())
}

/// An answer that becomes an abort: entries of a mapping have too many bits.
fn aborted(frame: Frame) -> Option<Frame> {
    let mut data = frame.padded_data();
    data[0] = 0x80;
    data[4..].copy_from_slice(&0x0604_0042_u32.to_le_bytes());
    Frame::new(frame.cob_id(), &data)
}

/// The cases that fail by one of these.
pub fn seen_to_fail() -> impl Iterator<Item = String> {
    let sheets = WRONG_SHEETS.iter().flat_map(|sheet| numbers(sheet.3));
    SABOTAGES.iter().flat_map(|sabotage| numbers(sabotage.1)).chain(sheets)
}

#[test]
fn each_broken_rule_is_found_by_the_cases_that_prove_it_and_no_other() {
    let mut faults = Vec::new();
    for (rule, found_by, to_node, of_node) in SABOTAGES {
        // All cases of the groups in which one fails.
        let places = |c: char| c == ' ' || c.is_ascii_digit();
        let groups: Vec<_> =
            found_by.split(", ").map(|cases| cases.trim_end_matches(places)).collect();
        let found = failures(&groups, *to_node, *of_node);
        let expected: Vec<_> = numbers(found_by).collect();
        if found != expected {
            faults.push(format!("{rule}: {found:?}, not {expected:?}"));
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

#[test]
fn no_case_fails_on_an_honest_line() {
    assert_eq!(failures(&[], unchanged, unchanged), [""; 0]);
}

#[test]
fn entries_of_more_than_64_bits_may_be_refused_at_the_entry() {
    // The third dummy of 32 bits, and the fifth value of 16 bits.
    let at_the_entry: Change = |frame| match frame.data() {
        [0x60, _, 0x16, 3, ..] | [0x60, _, 0x1A, 5, ..] => aborted(frame),
        _ => Some(frame),
    };
    assert_eq!(failures(&["PDO 26"], unchanged, at_the_entry), [""; 0]);
}

#[test]
fn the_cases_of_1010h_are_skipped_on_a_device_that_also_stores_by_itself() {
    let by_itself: Change = |frame| match frame.data() {
        [0x43, 0x10, 0x10, _, 1, ..] => with_byte(frame, 4, 3),
        _ => Some(frame),
    };
    let outcomes = outcomes(&right_sheet(), &["Testing other"], unchanged, by_itself);
    let skipped: Vec<bool> =
        outcomes.iter().map(|(_, outcome)| matches!(outcome, Outcome::Skipped(_))).collect();
    assert_eq!(skipped, [true, true, false, false, true, true, false, false, false, false]);
}

/// The sheet with another value of a key, which its section has.
fn with_key(sheet: &str, section: &str, key: &str, value: &str) -> String {
    let (before, rest) = sheet.split_once(&format!("[{section}]")).expect("the section");
    let (keys, after) = rest.split_once(&format!("{key}=")).expect("the key");
    let (_, after) = after.split_once('\n').expect("a line");
    format!("{before}[{section}]{keys}{key}={value}\n{after}")
}

/// Values of data sheets that are not those of the device, and the cases that find them.
const WRONG_SHEETS: [(&str, &str, &str, &str); 7] = [
    ("1015", "DefaultValue", "7", "OD 2, State 1"),
    ("1A00sub1", "DefaultValue", "0x60000110", "EDS checker, PDO 21, OD 2, State 1"),
    ("6000sub1", "PDOMapping", "0", "EDS checker, PDO 21"),
    // A text, which has no fixed length.
    ("2101sub3", "PDOMapping", "1", "EDS checker"),
    // In a PDO a BOOLEAN has one bit.
    ("6000sub1", "DataType", "0x0001", "EDS checker, PDO 21 25"),
    ("DummyUsage", "Dummy0001", "1", "PDO 33"),
    ("1600sub8", "DefaultValue", "0x620001FF", "OD 2, State 1"),
];

#[test]
fn a_data_sheet_that_is_not_that_of_the_device_is_found() {
    for (section, key, value, found_by) in WRONG_SHEETS {
        let sheet = with_key(&right_sheet(), section, key, value);
        let failed = failed(outcomes(&sheet, &[], unchanged, unchanged));
        let expected: Vec<_> = numbers(found_by).collect();
        assert_eq!(failed, expected, "[{section}] {key}={value}");
    }
}

#[test]
fn no_data_sheet_makes_the_program_panic() {
    const VALUES: &str = " 0 1 3 255 -1 0xFF 0x0001 0x0008 0x0009 0x000F 0x0015 0x001B 0xFFFFFFFF 0x00070020 \
        0x60000101 0x62000108 rw ro wo rww $NODEID+0x180 --170141183460469231731687303715884105728 \
        170141183460469231731687303715884105727+1";
    let values: Vec<_> = VALUES.split(' ').collect();
    let mut random = Random::from_environment();
    let sheet = right_sheet();
    for _ in 0..15 {
        let mut lines: Vec<String> = sheet.lines().map(str::to_owned).collect();
        for _ in 0..random.within(1..20) {
            let line = random.within(0..lines.len() as u64) as usize;
            let value = random.pick(&values);
            lines[line] = match lines[line].split_once('=') {
                Some((key, _)) => format!("{key}={value}"),
                // The highest sub-index of an object.
                None => lines[line].replace("sub8]", "subFF]"),
            };
        }
        let name = lines.iter().position(|line| line == "[1600sub8]");
        if let (Some(line), true) = (name, random.one_in(2)) {
            lines[line] = "[1600subFF]".into();
        }
        outcomes(&lines.join("\n"), &[], unchanged, unchanged);
    }
}
