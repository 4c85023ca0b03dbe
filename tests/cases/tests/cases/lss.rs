//! The LSS chapter on five nodes in the process: all of its cases hold, and with a line that breaks a rule, those that
//! prove it fail.

mod rules;

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    time::{Duration, Instant},
};

use can_bus::{
    adapter::{Adapter, Mode, Received},
    stop::Stop,
};
use canopen_node::{BitRate, Frame, lss::Address};
use conformance::{
    Bench, Lab, Line, Outcome, Report,
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
use rules::SABOTAGES;

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
    start: Instant,
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
        let (memory, attached) = (Memory::default(), SERIAL_NUMBERS.len());
        Self { bus, rate: RATE, rule, memory, attached, start: Instant::now() }
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

impl Adapter for Boards {
    fn open(&mut self, rate: BitRate, _: Mode) -> Result<(), Stop> {
        self.rate = rate;
        self.bus.open(rate, true);
        Ok(())
    }

    fn close(&mut self) -> Result<(), Stop> {
        Ok(())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Stop> {
        self.remember();
        let frames = (self.rule.to_device)(&mut self.memory, *frame);
        self.memory.note(frame);
        frames.into_iter().for_each(|frame| self.bus.send(frame));
        Ok(())
    }

    fn receive(&mut self, wait: Duration) -> Result<Option<Received>, Stop> {
        let start = self.start;
        let received = |(us, frame)| {
            let at = Duration::from_micros(us);
            Received { frame, at, here: start + at }
        };
        let until = self.bus.now() + wait.as_nanos().div_ceil(1_000) as u64;
        loop {
            let added = self.memory.added.front().map_or(u64::MAX, |(at, _)| *at);
            let Some((at, frame)) = self.bus.run(until.min(added)) else {
                let added = self.memory.added.pop_front_if(|(at, _)| *at <= until);
                return Ok(added.map(received));
            };
            self.remember();
            if frame.cob_id() == 0x7E4 && frame.data()[0] == 0x44 {
                self.memory.is_configuring = true;
            }
            if let Some(frame) = (self.rule.of_device)(&mut self.memory, frame) {
                return Ok(Some(received((at, frame))));
            }
        }
    }

    fn now(&self) -> Instant {
        self.start + Duration::from_micros(self.bus.now())
    }

    fn description(&self) -> String {
        String::new()
    }

    fn send_remote(&mut self, cob_id: u16, _: u8) -> Result<bool, Stop> {
        if self.rule.takes_all && cob_id == 0x7E5 {
            self.bus.send(request(&[0x04, 1]));
        }
        Ok(true)
    }

    fn send_extended(&mut self, _: u32, data: &[u8]) -> Result<bool, Stop> {
        if self.rule.takes_all {
            self.bus.send(request(data));
        }
        Ok(true)
    }
}

impl Lab for Boards {
    fn power(&mut self, is_on: bool) {
        let happening = if is_on { Happening::PowerOn } else { Happening::PowerOff };
        self.happen(0..self.attached, happening);
    }

    fn attach(&mut self, count: usize) {
        if count != self.attached {
            self.happen(count..SERIAL_NUMBERS.len(), Happening::PowerOff);
            self.happen(0..count, Happening::PowerOn);
            self.attached = count;
            self.bus.pass_us(START_US);
        }
    }

    fn unsent(&mut self) -> usize {
        // Who is at this bit rate acknowledges, also in the silence of a switch.
        let slaves = self.bus.slaves.iter().filter(|slave| slave.is_powered);
        let mut slaves = slaves.map(|slave| &slave.rig);
        let acknowledges = |rig: &NodeRig| rig.bit_rate() == self.rate && !rig.node.is_listening();
        usize::from(!slaves.any(acknowledges))
    }

    fn fail_stores(&mut self, fails: bool) {
        let flash = &self.bus.slaves[0].rig.flash;
        if fails { flash.fail(Operation::Write) } else { flash.repair() }
    }
}

/// The numbers and the outcomes of the cases that are wanted; empty: all.
fn outcomes(rule: Rule, wanted: &[String]) -> Vec<(String, Outcome)> {
    let mut line = Boards::new(rule);
    line.bus.pass_us(START_US);
    let eds = Eds::default();
    let mut bench = Bench::new(Line::Lab(&mut line), &eds, NODE);
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

#[test]
fn what_needs_an_sdo_server_is_skipped_on_nodes_without_one() {
    let rule = Rule {
        of_device: |_, frame| {
            Some(frame).filter(|frame| !(0x581..=0x5FF).contains(&frame.cob_id()))
        },
        ..HONEST
    };
    let mut others = outcomes(rule, &[]);
    others.retain(|(_, found)| *found != Outcome::Passed);
    let [(number, Outcome::Skipped(why)), (rescue, _)] = &others[..] else { panic!("{others:?}") };
    assert_eq!([&**number, rescue], ["LSS node-ID 09", WITHOUT_RESCUE[0]]);
    assert!(why.contains("`--without sdo`"), "{why}");
}

/// On the bus in the process somebody acknowledges every frame, so that each bit rate proves right:
/// `cargo verify conformance` looks at this case.
pub const WITHOUT_RESCUE: [&str; 1] = ["LSS further 19"];

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
