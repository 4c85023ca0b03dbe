//! The cases on a node in the process: all hold, and with a line that breaks a rule, or with a wrong data sheet, those
//! that prove it fail.

use std::{collections::VecDeque, time::Duration};

use canopen_node::{Action, Frame, Node};
use conformance::{APPLICATION_LAYER, Bench, Broken, Line, Outcome, Report, eds::Eds};
use example_io::application::{self as io, Application};
use testkit::{
    eds::{DataSheet, Product},
    flash::BoardFlash,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    random::Random,
};

const NODE: u8 = 0x40;
/// One more than the image has: a case needs two.
const PRODUCERS: usize = 2;
const TO_SERVER: u16 = 0x640;
const OF_SERVER: u16 = 0x5C0;

/// What a line makes of a frame; `None`: it is lost.
type Change = fn(Frame) -> Option<Frame>;

/// The node, on a line that changes frames to it and from it.
struct Saboteur {
    rig: NodeRig<Application, { io::TPDOS }, { io::RPDOS }, PRODUCERS>,
    to_node: Change,
    of_node: Change,
    received: VecDeque<(Duration, Frame)>,
}

impl Saboteur {
    fn take_sent(&mut self) {
        for (us, action) in self.rig.take_timed_actions() {
            if let Action::Transmit(frame) = action
                && let Some(frame) = (self.of_node)(frame)
            {
                self.received.push_back((Duration::from_micros(us), frame));
            }
        }
    }
}

impl Line for Saboteur {
    fn now(&self) -> Duration {
        Duration::from_micros(self.rig.now())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Broken> {
        if let Some(frame) = (self.to_node)(*frame) {
            self.rig.receive(&frame);
            self.take_sent();
        }
        Ok(())
    }

    fn receive(&mut self, until: Duration) -> Result<Option<(Duration, Frame)>, Broken> {
        while self.received.is_empty() && self.now() < until {
            let left = (until - self.now()).as_micros() as u64;
            self.rig.pass_us(left.min(1_000));
            self.take_sent();
        }
        Ok(self.received.pop_front())
    }

    fn jitter(&self) -> Duration {
        Duration::from_millis(1)
    }
}

/// The data sheet of the node.
fn right_sheet() -> String {
    let device = device(ADDRESS).with_defaults(defaults(NODE));
    let product = Product { file_name: "io.eds", vendor_name: "", description: "", device };
    let entries = Node::<Application, { io::TPDOS }, { io::RPDOS }, PRODUCERS>::entries(&device);
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
    let mut line = Saboteur { rig, to_node, of_node, received: VecDeque::new() };
    let mut bench = Bench::new(&mut line, &eds, NODE);
    let mut report = Report::new("node");
    let wanted: Vec<_> = wanted.iter().map(|case| (*case).to_owned()).collect();
    // A device that never boots up ends the run early.
    let _ = conformance::run(&mut bench, APPLICATION_LAYER, &wanted, &mut report, |_| ());
    report.findings.into_iter().map(|finding| (finding.number, finding.outcome)).collect()
}

/// The numbers of the cases that fail.
fn failed(outcomes: Vec<(String, Outcome)>) -> Vec<String> {
    let failed = outcomes.into_iter().filter(|(_, outcome)| matches!(outcome, Outcome::Failed(_)));
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

/// Asserts that exactly these cases fail of those that begin with one of `wanted`: `SDO 3 5, PDO 23`.
#[track_caller]
fn assert_found(wanted: &[&str], to_node: Change, of_node: Change, expected: &str) {
    let number = |group: &str, place: &str| format!("{group} {place:0>2}");
    let numbers = expected.split(", ").flat_map(|group| {
        let places = group.find(|c: char| c.is_ascii_digit()).expect("a number");
        let (name, places) = group.split_at(places);
        places.split(' ').map(move |place| number(name.trim(), place))
    });
    assert_eq!(failures(wanted, to_node, of_node), numbers.collect::<Vec<_>>());
}

#[test]
fn no_case_fails_on_an_honest_line() {
    assert_eq!(failures(&[], unchanged, unchanged), [""; 0]);
}

#[test]
fn wrong_abort_codes_are_found() {
    let wrong: Change = |frame| match frame.data() {
        [0x80, ..] if frame.cob_id() == OF_SERVER => with_byte(frame, 7, 0x07),
        _ => Some(frame),
    };
    let expected = "SDO 3 4 5 6 7 8 9 10 11 17 26 27 28, PDO 23 24 25 26 28 29 31 32, OD 3 4 6, \
                    Emergency 3, Synchronization 5 9, Heartbeat 4, Testing other 1 3 5 7 10";
    assert_found(&[], unchanged, wrong, expected);
}

#[test]
fn wrong_values_segments_and_checksums_are_found() {
    let value: Change = |frame| match *frame.data() {
        [0x43, _, _, _, byte, ..] if frame.cob_id() == OF_SERVER => with_byte(frame, 4, byte ^ 1),
        _ => Some(frame),
    };
    assert_found(&["SDO", "Emergency 01"], unchanged, value, "SDO 12 19, Emergency 1");
    let toggle: Change = |frame| match *frame.data() {
        [byte @ 0..0x20, ..] if frame.cob_id() == OF_SERVER => with_byte(frame, 0, byte ^ 0x10),
        _ => Some(frame),
    };
    assert_found(&["SDO"], unchanged, toggle, "SDO 16 18 22 23");
    let checksum: Change = |frame| match *frame.data() {
        [command, byte, ..] if frame.cob_id() == OF_SERVER && command & 0xE3 == 0xC1 => {
            with_byte(frame, 1, byte ^ 1)
        }
        _ => Some(frame),
    };
    assert_found(&["SDO"], unchanged, checksum, "SDO 19 22 23");
}

#[test]
fn a_device_that_neither_stores_nor_restores_is_found() {
    // The writes become reads, and the answers confirm writes.
    let to_read: Change = |frame| match frame.data() {
        [0x23, 0x10 | 0x11, 0x10, ..] if frame.cob_id() == TO_SERVER => with_byte(frame, 0, 0x40),
        _ => Some(frame),
    };
    let to_confirmation: Change = |frame| match frame.data() {
        [0x43, 0x10 | 0x11, 0x10, ..] if frame.cob_id() == OF_SERVER => with_byte(frame, 0, 0x60),
        _ => Some(frame),
    };
    let wanted = ["Synchronization 10", "Testing other"];
    let expected = "Synchronization 10, Testing other 1 2 3 4 5 6 7 8 9";
    assert_found(&wanted, to_read, to_confirmation, expected);
}

#[test]
fn missing_frames_are_found() {
    let heartbeat: Change =
        |frame| (frame.data() == [0] || frame.cob_id() != 0x740).then_some(frame);
    let expected = "Heartbeat 2 7, State 1 2 3 4, Transition 1 2 3 4";
    assert_found(&[], unchanged, heartbeat, expected);
    let pdo: Change = |frame| (!(0x180..0x580).contains(&frame.cob_id())).then_some(frame);
    assert_found(&[], unchanged, pdo, "PDO 4 5 6 7 8, Synchronization 3, State 3");
    let emergency: Change = |frame| (frame.cob_id() != 0xC0).then_some(frame);
    assert_found(&[], unchanged, emergency, "Emergency 4 5 6, Heartbeat 6 7");
    let boot_up: Change = |frame| (frame.data() != [0]).then_some(frame);
    assert_found(&["Emergency"], unchanged, boot_up, "Emergency 1 2 3");
}

#[test]
fn services_in_a_wrong_nmt_state_are_found() {
    // Whatever the command but a reset, the node starts.
    let start: Change = |frame| match frame.data() {
        [1 | 2 | 0x80, _] if frame.cob_id() == 0 => with_byte(frame, 0, 1),
        _ => Some(frame),
    };
    let expected = "PDO 10 11 12 13 14 16 17 18 19 20, State 2 4, Transition 2 3 4";
    assert_found(&[], start, unchanged, expected);
}

/// The abort of a download that the server has confirmed: the entries have too many bits.
fn too_long(frame: Frame) -> Option<Frame> {
    let mut data = frame.padded_data();
    data[0] = 0x80;
    data[4..].copy_from_slice(&0x0604_0042_u32.to_le_bytes());
    Frame::new(frame.cob_id(), &data)
}

#[test]
fn entries_of_more_than_64_bits_may_be_refused_at_the_entry_but_not_before_and_must_be_refused() {
    // The third dummy of 32 bits, and the fifth value of 16 bits.
    let at_the_entry: Change = |frame| match frame.data() {
        [0x60, _, 0x16, 3, ..] | [0x60, _, 0x1A, 5, ..] => too_long(frame),
        _ => Some(frame),
    };
    assert_eq!(failures(&["PDO 26"], unchanged, at_the_entry), [""; 0]);
    let before: Change = |frame| match frame.data() {
        [0x60, _, 0x16, 2, ..] => too_long(frame),
        _ => Some(frame),
    };
    assert_found(&["PDO 26"], unchanged, before, "PDO 26");
    let taken_by_rpdo: Change = |frame| match frame.data() {
        [0x80, _, 0x16, 0, ..] => with_byte(frame, 0, 0x60),
        _ => Some(frame),
    };
    assert_found(&["PDO 26"], unchanged, taken_by_rpdo, "PDO 26");
}

#[test]
fn a_synchronous_tpdo_that_its_timer_sends_is_found() {
    // A TPDO of type 254 with an event timer of 512 ms: one comes in each pause between two SYNCs.
    let timer: Change = |frame| match frame.data() {
        [0x2F, _, 0x18, 2, 0 | 1, ..] => with_byte(frame, 4, 254),
        [0x2B, _, 0x18, 5, 0, 0, ..] => with_byte(frame, 5, 2),
        _ => Some(frame),
    };
    assert_found(&["PDO"], timer, unchanged, "PDO 6 7 8");
}

#[test]
fn a_restricted_cob_id_that_is_taken_with_the_valid_bit_is_found() {
    // From 780h on the node gets an allowed number.
    let allowed: Change = |frame| match frame.data() {
        [0x23, 0x00, 0x18, 1, 0x80..=0xFF, 7, _, 0..0x80] => with_byte(frame, 5, 3),
        _ => Some(frame),
    };
    assert_found(&["Testing other 10"], allowed, unchanged, "Testing other 10");
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

#[test]
fn a_data_sheet_that_is_not_that_of_the_device_is_found() {
    for (section, key, value, expected) in [
        ("1015", "DefaultValue", "7", &["OD 02", "State 01"][..]),
        ("1A00sub1", "DefaultValue", "0x60000110", &["EDS checker", "PDO 21", "OD 02", "State 01"]),
        ("6000sub1", "PDOMapping", "0", &["EDS checker", "PDO 21"]),
        // A text, which has no fixed length.
        ("2101sub3", "PDOMapping", "1", &["EDS checker"]),
        // In a PDO a BOOLEAN has one bit.
        ("6000sub1", "DataType", "0x0001", &["EDS checker", "PDO 21", "PDO 25"]),
        ("DummyUsage", "Dummy0001", "1", &["PDO 33"]),
        ("1600sub8", "DefaultValue", "0x620001FF", &["OD 02", "State 01"]),
    ] {
        let sheet = with_key(&right_sheet(), section, key, value);
        let failed = failed(outcomes(&sheet, &[], unchanged, unchanged));
        assert_eq!(failed, expected, "[{section}] {key}={value}");
    }
}

#[test]
fn no_data_sheet_makes_the_program_panic() {
    const VALUES: [&str; 24] = [
        "",
        "0",
        "1",
        "3",
        "255",
        "-1",
        "0xFF",
        "0x0001",
        "0x0008",
        "0x0009",
        "0x000F",
        "0x0015",
        "0x001B",
        "0xFFFFFFFF",
        "0x00070020",
        "0x60000101",
        "0x62000108",
        "rw",
        "ro",
        "wo",
        "rww",
        "$NODEID+0x180",
        "--170141183460469231731687303715884105728",
        "170141183460469231731687303715884105727+1",
    ];
    let mut random = Random::from_environment();
    let sheet = right_sheet();
    for _ in 0..15 {
        let mut lines: Vec<String> = sheet.lines().map(str::to_owned).collect();
        for _ in 0..random.within(1..20) {
            let line = random.within(0..lines.len() as u64) as usize;
            let value = random.pick(&VALUES);
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
