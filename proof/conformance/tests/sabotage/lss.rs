//! The LSS chapter on five nodes in the process: all of its cases hold, and with a line that breaks a rule, those that
//! prove it fail.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    time::Duration,
};

use canopen_node::{BitRate, Frame, lss::Address};
use conformance::{
    Bench, Broken, Line, Outcome, Report,
    eds::Eds,
    lss::{Feature, LSS, Target},
};
use testkit::{
    flash::Operation,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    random::Random,
    slave_bus::{Habits, Happening, SlaveBus},
};

use crate::{has_failed, numbers};

/// The node-ID of the first device.
const NODE: u8 = 5;
/// That of all devices.
const RATE: BitRate = BitRate::Kbit1000;
/// As on the emulated boards: the first and the fourth differ in one bit.
const SERIAL_NUMBERS: [u32; 5] = [0x1E00, 0x1275, 0x2469, 0x0010_1E00, 0x8000_1234];
/// The time from power-on to the bus.
const START_US: u64 = 100_000;

/// What the line has seen, and what it adds.
#[derive(Default)]
struct Memory {
    now: u64,
    /// The active node-ID of the first device.
    node: Option<u8>,
    /// Whether the devices are in LSS configuration state, as far as 04, 44 and resets tell.
    is_configuring: bool,
    is_stopped: bool,
    /// The last request.
    request: [u8; 8],
    /// The time of the last request.
    requested_at: u64,
    /// The numbers of the last request with each command specifier.
    numbers: BTreeMap<u8, u32>,
    /// The bits of 40, 41, 42, 43 since a select began.
    parts: u8,
    /// The bit rate index of a 13 that was not the devices' own.
    other_rate: Option<u8>,
    /// Frames for the tool, with their times.
    added: VecDeque<(u64, Frame)>,
}

impl Memory {
    /// Answers in place of a device, or in addition.
    fn answer(&mut self, bytes: &[u8]) {
        self.add(300, 0x7E4, &padded(bytes));
    }

    fn add(&mut self, after_us: u64, cob_id: u16, data: &[u8]) {
        let frame = Frame::new(cob_id, data).expect("at most eight bytes");
        self.added.push_back((self.now + after_us, frame));
    }

    /// Notes a frame of the tool.
    fn note(&mut self, frame: &Frame) {
        match (frame.cob_id(), frame.data()) {
            (0, [command @ (0x81 | 0x82), _]) => {
                self.is_configuring = false;
                self.is_stopped = false;
                self.parts = 0;
                if *command == 0x81 {
                    self.other_rate = None;
                }
            }
            (0, [command, _]) => self.is_stopped = *command == 2,
            (0x7E5, data) if data.len() == 8 => {
                let data = frame.padded_data();
                self.request = data;
                self.requested_at = self.now;
                self.numbers.insert(data[0], number(frame));
                match data {
                    [0x04, mode @ 0..=1, ..] => (self.is_configuring, self.parts) = (mode == 1, 0),
                    [0x13, 0, index, ..] if index != RATE.index() => self.other_rate = Some(index),
                    [0x13, 0, ..] => self.other_rate = None,
                    _ => {}
                }
            }
            _ => {}
        }
    }
}

fn padded(bytes: &[u8]) -> [u8; 8] {
    let mut padded = [0; 8];
    padded[..bytes.len()].copy_from_slice(bytes);
    padded
}

fn request(bytes: &[u8]) -> Frame {
    Frame::new(0x7E5, &padded(bytes)).expect("eight bytes")
}

fn nmt(command: u8) -> Frame {
    Frame::new(0, &[command, 0]).expect("two bytes")
}

fn with_number(command: u8, number: u32) -> Frame {
    let [a, b, c, d] = number.to_le_bytes();
    request(&[command, a, b, c, d])
}

fn number(frame: &Frame) -> u32 {
    let [_, a, b, c, d, ..] = frame.padded_data();
    u32::from_le_bytes([a, b, c, d])
}

/// The command specifier of a request.
fn command(frame: &Frame) -> Option<u8> {
    (frame.cob_id() == 0x7E5 && frame.data().len() == 8).then(|| frame.data()[0])
}

/// The bytes of an LSS answer.
fn answer(frame: &Frame) -> Option<[u8; 8]> {
    (frame.cob_id() == 0x7E4).then(|| frame.padded_data())
}

fn with_byte(frame: Frame, place: usize, byte: u8) -> Frame {
    let mut data = frame.padded_data();
    data[place] = byte;
    Frame::new(frame.cob_id(), &data).expect("eight bytes")
}

/// A part of the first device's LSS address.
fn part(command: u8, base: u8) -> u32 {
    address(SERIAL_NUMBERS[0])[usize::from(command - base)]
}

fn address(serial_number: u32) -> [u32; 4] {
    Address { serial_number, ..ADDRESS }.into()
}

/// What a line does with frames.
#[derive(Clone, Copy)]
struct Rule {
    to_device: fn(&mut Memory, Frame) -> Vec<Frame>,
    of_device: fn(&mut Memory, Frame) -> Option<Frame>,
    /// Whether remote frames and those with 29-bit identifiers arrive as requests.
    takes_all: bool,
    /// The time to an answer.
    answer_us: u64,
}

const HONEST: Rule = Rule {
    to_device: |_, frame| vec![frame],
    of_device: |_, frame| Some(frame),
    takes_all: false,
    answer_us: 200,
};

/// The nodes on their line.
struct Boards {
    bus: SlaveBus,
    /// That of the line.
    rate: BitRate,
    rule: Rule,
    memory: Memory,
    attached: usize,
}

impl Boards {
    fn new(rule: Rule) -> Self {
        let rigs = SERIAL_NUMBERS.iter().zip(NODE..).map(|(serial_number, node)| {
            let address = Address { serial_number: *serial_number, ..ADDRESS };
            let device = device(address).with_rescue(true).with_defaults(defaults(node));
            let answer_us = rule.answer_us..rule.answer_us + 1;
            (NodeRig::of(device), Habits { answer_us, ..Habits::default() })
        });
        let mut bus = SlaveBus::new(rigs, Random::from_seed(1));
        bus.open(RATE, true);
        Self { bus, rate: RATE, rule, memory: Memory::default(), attached: SERIAL_NUMBERS.len() }
    }

    fn pass(&mut self, us: u64) {
        let until = self.bus.now() + us;
        while self.bus.run(until).is_some() {}
    }

    fn happen(&mut self, boards: std::ops::Range<usize>, happening: Happening) {
        let now = self.bus.now();
        boards.for_each(|board| self.bus.plan(now, board, happening));
    }

    /// Brings the memory up to date.
    fn remember(&mut self) {
        self.memory.now = self.bus.now();
        self.memory.node = self.bus.slaves[0].rig.node.node_id().map(|node| node.get());
    }
}

impl Line for Boards {
    fn now(&self) -> Duration {
        Duration::from_micros(self.bus.now())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Broken> {
        self.remember();
        let frames = (self.rule.to_device)(&mut self.memory, *frame);
        self.memory.note(frame);
        frames.into_iter().for_each(|frame| self.bus.send(frame));
        Ok(())
    }

    fn receive(&mut self, until: Duration) -> Result<Option<(Duration, Frame)>, Broken> {
        let until = until.as_micros() as u64;
        loop {
            let added = self.memory.added.front().map_or(u64::MAX, |(at, _)| *at);
            let Some((at, frame)) = self.bus.run(until.min(added)) else {
                let added = self.memory.added.pop_front_if(|(at, _)| *at <= until);
                return Ok(added.map(|(at, frame)| (Duration::from_micros(at), frame)));
            };
            self.remember();
            if frame.cob_id() == 0x7E4 && frame.data()[0] == 0x44 {
                self.memory.is_configuring = true;
            }
            if let Some(frame) = (self.rule.of_device)(&mut self.memory, frame) {
                return Ok(Some((Duration::from_micros(at), frame)));
            }
        }
    }

    fn jitter(&self) -> Duration {
        Duration::from_millis(1)
    }

    fn send_remote(&mut self, cob_id: u16, _: u8) -> Result<bool, Broken> {
        if self.rule.takes_all && cob_id == 0x7E5 {
            self.bus.send(request(&[0x04, 1]));
        }
        Ok(true)
    }

    fn send_extended(&mut self, _: u32, data: &[u8]) -> Result<bool, Broken> {
        if self.rule.takes_all {
            self.bus.send(request(data));
        }
        Ok(true)
    }

    fn set_bit_rate(&mut self, rate: BitRate) -> Result<bool, Broken> {
        self.rate = rate;
        self.bus.open(rate, true);
        Ok(true)
    }

    fn power(&mut self, is_on: bool) -> Result<bool, Broken> {
        let happening = if is_on { Happening::PowerOn } else { Happening::PowerOff };
        self.happen(0..self.attached, happening);
        Ok(true)
    }

    fn attach(&mut self, count: usize) -> Result<bool, Broken> {
        if count != self.attached {
            self.happen(count..SERIAL_NUMBERS.len(), Happening::PowerOff);
            self.happen(0..count, Happening::PowerOn);
            self.attached = count;
            self.pass(START_US);
        }
        Ok(true)
    }

    fn unsent(&mut self) -> Result<Option<usize>, Broken> {
        // Who is at this bit rate acknowledges, also in the silence of a switch.
        let slaves = self.bus.slaves.iter().filter(|slave| slave.is_powered);
        let mut slaves = slaves.map(|slave| &slave.rig);
        let acknowledges = |rig: &NodeRig| rig.bit_rate() == self.rate && !rig.node.is_listening();
        Ok(Some(usize::from(!slaves.any(acknowledges))))
    }

    fn fail_stores(&mut self, fails: bool) -> Result<bool, Broken> {
        let flash = &self.bus.slaves[0].rig.flash;
        if fails {
            flash.fail(Operation::Write)
        } else {
            flash.repair()
        }
        Ok(true)
    }
}

/// The numbers and the outcomes of the cases that are wanted; empty: all.
fn outcomes(rule: Rule, wanted: &[String]) -> Vec<(String, Outcome)> {
    let mut line = Boards::new(rule);
    line.pass(START_US);
    let eds = Eds::default();
    let mut bench = Bench::new(&mut line, &eds, NODE);
    let devices = SERIAL_NUMBERS.map(|number| Address::from(address(number))).to_vec();
    bench.lss = Target::new(devices, RATE, vec![Feature::Detect, Feature::Rescue]);
    let mut report = Report::new("five nodes");
    // A device that is never found ends the run early.
    let _ = conformance::run(&mut bench, LSS, wanted, &mut report, |_| ());
    report.findings.into_iter().map(|finding| (finding.number, finding.outcome)).collect()
}

#[test]
fn every_case_of_lss_passes_on_nodes_of_ours() {
    let others = outcomes(HONEST, &[]).into_iter().filter(|(_, found)| *found != Outcome::Passed);
    let others: Vec<String> = others.map(|(number, _)| number).collect();
    assert_eq!(others, WITHOUT_RESCUE);
}

/// On the bus in the process somebody acknowledges every frame, so that each bit rate proves right:
/// `cargo verify conformance` looks at this case.
pub const WITHOUT_RESCUE: [&str; 1] = ["LSS further 19"];

/// What a device does wrong, its line, and the cases that fail by that: `LSS states 3 5`.
const SABOTAGES: &[(&str, Rule, &str)] = &[
    (
        "04 00 is not obeyed",
        Rule { to_device: |_, frame| lost(frame, |data| data[..2] == [4, 0]), ..HONEST },
        "LSS states 1",
    ),
    (
        "04 is answered",
        Rule {
            to_device: |memory, frame| {
                if command(&frame) == Some(0x04) {
                    memory.answer(&[0x04]);
                }
                vec![frame]
            },
            ..HONEST
        },
        "LSS states 1 2",
    ),
    (
        "04 takes any mode by its lowest bit",
        Rule {
            to_device: |_, frame| match *frame.data() {
                [0x04, mode, ..] if command(&frame).is_some() => {
                    vec![with_byte(frame, 1, mode & 1)]
                }
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS states 2",
    ),
    (
        "A select has no answer",
        Rule { of_device: |_, frame| no_answer(frame, 0x44), ..HONEST },
        "LSS states 3 5 10, LSS unconfigured 5, LSS frames 6",
    ),
    (
        "Every LSS address is its own",
        Rule {
            to_device: |_, frame| match command(&frame) {
                Some(select @ 0x40..=0x43) => vec![with_number(select, part(select, 0x40))],
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS states 4, LSS several 2 3 4 5 6 7",
    ),
    (
        "40 does not begin a select again",
        Rule {
            to_device: |memory, frame| match command(&frame) {
                Some(0x40) if memory.parts & 1 == 1 => vec![],
                Some(select @ 0x40..=0x43) => {
                    memory.parts |= 1 << (select - 0x40);
                    vec![frame]
                }
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS states 5",
    ),
    (
        "A select works in configuration too",
        Rule {
            to_device: |memory, frame| match command(&frame) {
                Some(0x40) if memory.is_configuring => vec![request(&[4, 0]), frame],
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS states 6",
    ),
    (
        "Each 43 is answered",
        Rule { to_device: |memory, frame| answered(memory, frame, 0x43, &[0x44]), ..HONEST },
        "LSS states 4 6, LSS further 1 2 3 4 15",
    ),
    (
        "5A to 5D are answered with another number",
        Rule {
            of_device: |_, frame| match answer(&frame) {
                Some([0x5A..=0x5D, byte, ..]) => Some(with_byte(frame, 1, byte ^ 1)),
                _ => Some(frame),
            },
            ..HONEST
        },
        "LSS states 7, LSS Fastscan 4 5 6 11, LSS several 2 3 5, LSS further 14",
    ),
    (
        "5E is answered with the pending node-ID",
        Rule {
            of_device: |memory, frame| match answer(&frame) {
                Some([0x5E, ..]) => {
                    let pending = memory.numbers.get(&0x11).map(|number| *number as u8);
                    Some(with_byte(frame, 1, pending.unwrap_or(9)))
                }
                _ => Some(frame),
            },
            ..HONEST
        },
        "LSS node-ID 4 7, LSS store 2",
    ),
    (
        "5E is answered with the next node-ID",
        Rule {
            of_device: |memory, frame| match answer(&frame) {
                // What precedes the case goes on.
                Some([0x5E, id, ..]) if memory.requested_at < memory.now - 150 => {
                    Some(with_byte(frame, 2, id))
                }
                _ => Some(frame),
            },
            ..HONEST
        },
        "LSS states 8 10, LSS unconfigured 1",
    ),
    (
        "Waiting serves what configuration does",
        Rule {
            to_device: |memory, frame| match command(&frame) {
                Some(0x11..=0x17 | 0x5A..=0x5E) if !memory.is_configuring => {
                    vec![request(&[4, 1]), frame, request(&[4, 0])]
                }
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS states 1 9, LSS frames 1 2 4",
    ),
    (
        "LSS is not served in NMT state stopped",
        Rule {
            to_device: |memory, frame| match command(&frame) {
                Some(_) if memory.is_stopped => vec![],
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS states 10",
    ),
    (
        "NMT start, stop and enter pre-operational lead to waiting",
        Rule {
            to_device: |_, frame| match frame.data() {
                [1 | 2 | 0x80, _] if frame.cob_id() == 0 => vec![frame, request(&[4, 0])],
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS states 11",
    ),
    (
        "NMT resets lead to configuration",
        Rule {
            to_device: |_, frame| match frame.data() {
                [0x81 | 0x82, _] if frame.cob_id() == 0 => vec![frame, request(&[4, 1])],
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS states 12 13",
    ),
    (
        "Identify remote slave has no answer",
        Rule {
            of_device: |memory, frame| match memory.request[0] {
                0x4B => no_answer(frame, 0x4F),
                _ => Some(frame),
            },
            ..HONEST
        },
        "LSS identify 1 2 3 4 7, LSS several 1, LSS further 5 6",
    ),
    (
        "Identify remote slave has no answer without a node-ID",
        Rule {
            of_device: |memory, frame| match memory.node {
                None => no_answer(frame, 0x4F),
                _ => Some(frame),
            },
            ..HONEST
        },
        "LSS identify 2",
    ),
    (
        "Each 4B is answered",
        Rule { to_device: |memory, frame| answered(memory, frame, 0x4B, &[0x4F]), ..HONEST },
        "LSS identify 5 6 7 8 9, LSS several 1, LSS further 5",
    ),
    (
        "The bounds of identify have a sign",
        Rule {
            to_device: |memory, frame| match command(&frame) {
                Some(high @ (0x49 | 0x4B)) => {
                    let own = part(0x42 + (high - 0x49) / 2, 0x40) as i32;
                    let low = memory.numbers.get(&(high - 1)).map_or(0, |low| *low as i32);
                    let is_within = (low..=number(&frame) as i32).contains(&own);
                    if is_within { vec![frame] } else { vec![] }
                }
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS identify 3 4, LSS several 1",
    ),
    (
        "The high bound of identify is no part of the range",
        Rule {
            to_device: |_, frame| match command(&frame) {
                Some(high @ (0x49 | 0x4B)) => {
                    vec![with_number(high, number(&frame).saturating_sub(1))]
                }
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS identify 1 2 3 4 7, LSS several 1, LSS further 5",
    ),
    (
        "The bounds of identify are taken in any order",
        Rule {
            to_device: |memory, frame| match command(&frame) {
                Some(0x48 | 0x4A) => vec![],
                Some(high @ (0x49 | 0x4B)) => {
                    let low = memory.numbers.get(&(high - 1)).copied().unwrap_or(0);
                    let (low, high_bound) = (low.min(number(&frame)), low.max(number(&frame)));
                    vec![with_number(high - 1, low), with_number(high, high_bound)]
                }
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS identify 6",
    ),
    (
        "Identify does not compare vendor-ID and product code",
        Rule {
            to_device: |_, frame| match command(&frame) {
                Some(identify @ (0x46 | 0x47)) => {
                    vec![with_number(identify, part(identify, 0x46))]
                }
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS identify 8",
    ),
    (
        "A range of revisions compares the minor part",
        Rule {
            to_device: |_, frame| match command(&frame) {
                Some(0x49) if number(&frame) & 0xFFFF < part(0x42, 0x40) & 0xFFFF => vec![],
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS further 6",
    ),
    (
        "4C has no answer",
        Rule { of_device: |_, frame| no_answer(frame, 0x50), ..HONEST },
        "LSS unconfigured 2, LSS several 6",
    ),
    (
        "Each 4C is answered",
        Rule { to_device: |memory, frame| answered(memory, frame, 0x4C, &[0x50]), ..HONEST },
        "LSS unconfigured 3 4, LSS several 6",
    ),
    (
        "The boot-up is that of the next node",
        Rule {
            of_device: |_, frame| match (frame.cob_id(), frame.data()) {
                (cob_id @ 0x701..0x77F, [0]) => Frame::new(cob_id + 1, &[0]),
                _ => Some(frame),
            },
            ..HONEST
        },
        "LSS unconfigured 5, LSS node-ID 3 5 6 7, LSS several 5 6 7, LSS bit rate 5 12",
    ),
    (
        "A device without a node-ID has an SDO server",
        Rule {
            to_device: |memory, frame| {
                if frame.cob_id() == 0x605 && memory.node.is_none() {
                    memory.add(300, 0x585, &[0x43, 0, 0x10, 0, 0, 0, 0, 0]);
                }
                vec![frame]
            },
            ..HONEST
        },
        "LSS unconfigured 6",
    ),
    (
        "Fastscan has no answer",
        Rule {
            of_device: |memory, frame| match memory.request[0] {
                0x51 => no_answer(frame, 0x4F),
                _ => Some(frame),
            },
            ..HONEST
        },
        "LSS Fastscan 1 4 5 6 7 8 9 10 11, LSS several 2 5, LSS further 7 8",
    ),
    (
        "Each 51 is answered",
        Rule { to_device: |memory, frame| answered(memory, frame, 0x51, &[0x4F]), ..HONEST },
        "LSS Fastscan 2 3 4 6 7 8 9 10 12, LSS several 5, LSS further 8",
    ),
    (
        "11, 13 and 17 accept everything",
        Rule {
            of_device: |_, frame| match answer(&frame) {
                Some([0x11 | 0x13 | 0x17, _, ..]) => Some(with_byte(frame, 1, 0)),
                _ => Some(frame),
            },
            ..HONEST
        },
        "LSS node-ID 2 3, LSS bit rate 2 3 4, LSS store 4, LSS further 9 10",
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
    (
        "11 refuses 100, and 13 has no answer",
        Rule {
            of_device: |memory, frame| match (answer(&frame), memory.request[1]) {
                (Some([0x11, ..]), 100) => Some(with_byte(frame, 1, 1)),
                _ => no_answer(frame, 0x13),
            },
            ..HONEST
        },
        "LSS node-ID 1, LSS bit rate 1",
    ),
    (
        "04 00 makes any pending node-ID active",
        Rule {
            to_device: |memory, frame| match frame.data() {
                [0x04, 0, ..] if memory.numbers.contains_key(&0x11) && memory.node.is_some() => {
                    vec![frame, nmt(0x82)]
                }
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS node-ID 6",
    ),
    (
        "Node-ID 255 is no node-ID to take",
        Rule {
            to_device: |memory, frame| match frame.data() {
                [0x11, 0xFF, ..] if memory.is_configuring => vec![request(&[0x11, NODE])],
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS node-ID 8 14",
    ),
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
    (
        "Reset node does what reset communication does",
        Rule {
            to_device: |_, frame| match frame.data() {
                [0x81, _] if frame.cob_id() == 0 => vec![nmt(0x82)],
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS node-ID 10, LSS bit rate 13",
    ),
    (
        "Reset communication does what reset node does",
        Rule {
            to_device: |_, frame| match frame.data() {
                [0x82, _] if frame.cob_id() == 0 => vec![nmt(0x81)],
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS node-ID 3 5 6, LSS bit rate 12",
    ),
    (
        "17 stores nothing, and says that it did",
        Rule {
            to_device: |memory, frame| match command(&frame) {
                Some(0x17) if memory.is_configuring => answered(memory, frame, 0x17, &[0x17])
                    .into_iter()
                    .filter(|frame| command(frame).is_none())
                    .collect(),
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS node-ID 11 12 14, LSS store 3 4 5 6",
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
    (
        "17 has no answer",
        Rule { of_device: |_, frame| no_answer(frame, 0x17), ..HONEST },
        "LSS node-ID 11 12 14, LSS store 1 2 3 4 5 6, LSS further 17",
    ),
    (
        "17 makes the pending node-ID active",
        Rule {
            to_device: |_, frame| match command(&frame) {
                Some(0x17) => vec![frame, nmt(0x82), request(&[4, 1])],
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS store 2",
    ),
    (
        "13 acts at once",
        Rule {
            of_device: |memory, frame| match memory.other_rate {
                Some(_) if memory.request[0] != 0x13 => None,
                _ => Some(frame),
            },
            ..HONEST
        },
        "LSS bit rate 5",
    ),
    (
        "The delay of 15 is 5 ms longer",
        Rule {
            to_device: |_, frame| match *frame.data() {
                [0x15, low, high, ..] => {
                    let delay = u16::from_le_bytes([low, high]).saturating_add(5).to_le_bytes();
                    vec![request(&[0x15, delay[0], delay[1]])]
                }
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS bit rate 6 7 8",
    ),
    (
        "The delay of 15 is 5 ms shorter",
        Rule {
            to_device: |_, frame| match *frame.data() {
                [0x15, low, high, ..] => {
                    let delay = u16::from_le_bytes([low, high]).saturating_sub(5).to_le_bytes();
                    vec![request(&[0x15, delay[0], delay[1]])]
                }
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS bit rate 6 7 9",
    ),
    (
        "15 is not obeyed",
        Rule { to_device: |_, frame| lost(frame, |data| data[0] == 0x15), ..HONEST },
        "LSS bit rate 6 7 8 9 11 12, LSS several 8, LSS further 10 11",
    ),
    (
        "A boot-up in both delays of 15 and after them",
        Rule {
            to_device: |memory, frame| {
                if command(&frame) == Some(0x15) {
                    memory.add(20_000, 0x705, &[0]);
                    memory.add(150_000, 0x705, &[0]);
                }
                vec![frame]
            },
            ..HONEST
        },
        "LSS bit rate 10 11",
    ),
    (
        "Requests in both delays are answered",
        Rule {
            to_device: |memory, frame| match command(&frame) {
                Some(0x5E) if memory.request[0] == 0x15 => {
                    answered(memory, frame, 0x5E, &[0x5E, NODE])
                }
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS further 11 12",
    ),
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
    (
        "The highest bit of a command specifier does not count",
        Rule {
            to_device: |_, frame| match command(&frame) {
                Some(command) => vec![with_byte(frame, 0, command & 0x7F)],
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS frames 5",
    ),
    (
        "Reserved bytes are repeated in the answer",
        Rule {
            of_device: |memory, frame| match answer(&frame) {
                Some([0x44 | 0x11 | 0x13 | 0x5E, ..]) => {
                    Some(with_byte(frame, 7, memory.request[7]))
                }
                _ => Some(frame),
            },
            ..HONEST
        },
        "LSS frames 6",
    ),
    (
        "Each answer comes twice",
        Rule {
            of_device: |memory, frame| {
                if let Some(bytes) = answer(&frame) {
                    memory.answer(&bytes);
                }
                Some(frame)
            },
            ..HONEST
        },
        "LSS several 3 4, LSS further 14 15 16",
    ),
    (
        "A request right behind another is lost",
        Rule {
            to_device: |memory, frame| match command(&frame) {
                Some(_) if memory.now < memory.requested_at + 1_000 && memory.now > START_US => {
                    vec![]
                }
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS further 4 14 15 16 17",
    ),
    (
        "The steps of a select count in any order",
        Rule {
            to_device: |memory, frame| match command(&frame) {
                Some(select @ 0x40..=0x43) => {
                    memory.parts |= 1 << (select - 0x40);
                    if memory.parts != 0b1111 {
                        return vec![frame];
                    }
                    memory.parts = 0;
                    (0x40..=0x43).map(|select| with_number(select, part(select, 0x40))).collect()
                }
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS further 1",
    ),
    (
        "A refused 13 has error code 2",
        Rule {
            of_device: |_, frame| match answer(&frame) {
                Some([0x13, 1, ..]) => Some(with_byte(frame, 1, 2)),
                _ => Some(frame),
            },
            ..HONEST
        },
        "LSS further 9",
    ),
    (
        "NMT resets are not for a device without a node-ID",
        Rule {
            to_device: |memory, frame| match frame.cob_id() {
                0 if memory.node.is_none() => vec![],
                _ => vec![frame],
            },
            ..HONEST
        },
        "LSS further 13",
    ),
    ("An answer takes 5 ms", Rule { answer_us: 5_000, ..HONEST }, "LSS further 18"),
];

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

#[test]
fn each_rule_of_lss_that_is_broken_is_found_by_the_cases_that_prove_it() {
    let mut faults = Vec::new();
    for (what, rule, found_by) in SABOTAGES {
        let expected: Vec<String> = numbers(found_by).collect();
        let found = outcomes(*rule, &expected).into_iter();
        let found: BTreeSet<_> =
            found.filter(|(_, outcome)| has_failed(outcome)).map(|(number, _)| number).collect();
        let passed: Vec<_> = expected.iter().filter(|number| !found.contains(*number)).collect();
        if !passed.is_empty() || expected.is_empty() {
            faults.push(format!("{what}: not found by {passed:?}"));
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

/// The cases that fail by one of these.
pub fn seen_to_fail() -> impl Iterator<Item = String> {
    SABOTAGES.iter().flat_map(|(_, _, found_by)| numbers(found_by))
}
