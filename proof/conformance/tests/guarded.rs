//! The cases of services that no node of this repository has, node guarding and the SYNC producer, on a small device.

use std::{
    collections::{BTreeMap, VecDeque},
    time::Duration,
};

use canopen_node::Frame;
use conformance::{APPLICATION_LAYER, Address, Bench, Broken, Line, Outcome, Report, eds::Eds, ms};

const NODE: u8 = 5;
const PRE_OPERATIONAL: u8 = 127;
const STOPPED: u8 = 4;
/// The objects with their data types and their defaults.
const OBJECTS: [(Address, u8, u32); 9] = [
    ((0x1005, 0), 7, 0x80),
    ((0x1006, 0), 7, 5_000),
    ((0x100C, 0), 6, 0),
    ((0x100D, 0), 5, 0),
    ((0x1010, 1), 7, 1),
    ((0x1011, 1), 7, 1),
    ((0x1014, 0), 7, 0x85),
    ((0x1017, 0), 6, 0),
    ((0x1019, 0), 5, 0),
];

type Objects = BTreeMap<Address, u32>;

struct Device {
    now: Duration,
    objects: Objects,
    stored: Objects,
    /// Breaks the rules of the services: no toggle, guarding beside the heartbeat, counters from 0 on, and SYNC in NMT
    /// state stopped.
    is_faulty: bool,
    /// The NMT state, as in a heartbeat.
    state: u8,
    toggle: u8,
    next_heartbeat: Duration,
    next_sync: Duration,
    counter: u8,
    /// When life guarding ends, if it has begun.
    life_end: Option<Duration>,
    sent: VecDeque<Frame>,
}

fn defaults() -> Objects {
    OBJECTS.map(|(address, _, value)| (address, value)).into()
}

impl Device {
    fn new(is_faulty: bool) -> Self {
        Self {
            now: Duration::ZERO,
            objects: defaults(),
            stored: defaults(),
            is_faulty,
            state: PRE_OPERATIONAL,
            toggle: 0,
            next_heartbeat: Duration::ZERO,
            next_sync: Duration::ZERO,
            counter: 0,
            life_end: None,
            sent: VecDeque::new(),
        }
    }

    fn value(&self, index: u16) -> u32 {
        self.objects[&(index, 0)]
    }

    fn transmit(&mut self, cob_id: u16, data: &[u8]) {
        self.sent.push_back(Frame::new(cob_id, data).expect("a frame"));
    }

    fn reset(&mut self) {
        let fresh = Self::new(self.is_faulty);
        let (now, stored) = (self.now, std::mem::take(&mut self.stored));
        *self = Self { now, objects: stored.clone(), stored, ..fresh };
        self.transmit(0x705, &[0]);
    }

    fn serve(&mut self, request: &[u8]) {
        let address = (u16::from_le_bytes([request[1], request[2]]), request[3]);
        let number = u32::from_le_bytes(request[4..].try_into().expect("four bytes"));
        let known = OBJECTS.iter().find(|object| object.0 == address).map(|object| object.1);
        let length = 1 << known.unwrap_or(5).saturating_sub(5);
        let has_period = address == (0x1019, 0) && self.value(0x1006) > 0;
        let (command, answer) = match (request[0] >> 5, known) {
            (_, None) => (0x80, 0x0602_0000),
            (2, Some(_)) => (0x43 | (4 - length) << 2, self.objects[&address]),
            _ if has_period => (0x80, 0x0800_0022),
            _ if address == (0x1019, 0) && number == 1 => (0x80, 0x0609_0030),
            _ => (0x60, 0),
        };
        match (command, address) {
            (0x60, (0x1010, _)) => self.stored = self.objects.clone(),
            (0x60, (0x1011, _)) => self.stored = defaults(),
            (0x60, _) => drop(self.objects.insert(address, number)),
            _ => {}
        }
        let [a, b, c, d] = answer.to_le_bytes();
        self.transmit(0x585, &[command, request[1], request[2], request[3], a, b, c, d]);
    }

    /// Sends what is due.
    fn poll(&mut self) {
        let heartbeat = ms(self.value(0x1017).into());
        if !heartbeat.is_zero() && self.now >= self.next_heartbeat {
            self.next_heartbeat = self.now + heartbeat;
            self.transmit(0x705, &[self.state]);
        }
        let period = Duration::from_micros(self.value(0x1006).into());
        let produces = self.value(0x1005) >> 30 == 1 && (self.state != STOPPED || self.is_faulty);
        if produces && !period.is_zero() && self.now >= self.next_sync {
            self.next_sync = self.now + period;
            self.counter = self.counter % self.value(0x1019).max(1) as u8 + 1;
            let counter = [self.counter - u8::from(self.is_faulty)];
            self.transmit(0x080, &counter[..usize::from(self.value(0x1019) > 0)]);
        }
        if self.life_end.is_some_and(|end| self.now >= end) {
            self.life_end = None;
            self.transmit(0x085, &[0x30, 0x81, 0x11, 0, 0, 0, 0, 0]);
        }
    }
}

impl Line for Device {
    fn now(&self) -> Duration {
        self.now
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Broken> {
        match (frame.cob_id(), frame.data()) {
            (0x000, [0x81 | 0x82, _]) => self.reset(),
            (0x000, [1, _]) => self.state = 5,
            (0x000, [2, _]) => self.state = STOPPED,
            (0x000, [0x80, _]) => self.state = PRE_OPERATIONAL,
            (0x605, request) if self.state != STOPPED => self.serve(request),
            _ => {}
        }
        Ok(())
    }

    fn receive(&mut self, until: Duration) -> Result<Option<(Duration, Frame)>, Broken> {
        while self.sent.is_empty() && self.now < until {
            self.now += ms(1);
            self.poll();
        }
        Ok(self.sent.pop_front().map(|frame| (self.now, frame)))
    }

    fn jitter(&self) -> Duration {
        ms(1)
    }

    fn send_remote(&mut self, cob_id: u16, _: u8) -> Result<bool, Broken> {
        if cob_id == 0x705 && (self.value(0x1017) == 0 || self.is_faulty) {
            self.transmit(0x705, &[self.state | self.toggle]);
            self.toggle ^= if self.is_faulty { 0 } else { 0x80 };
            let life = self.value(0x100C) * self.value(0x100D);
            self.life_end = (life > 0).then(|| self.now + ms(life.into()));
        }
        Ok(true)
    }
}

/// Runs the cases of the two services; returns the numbers of those that have not passed.
fn not_passed(is_faulty: bool) -> Vec<String> {
    let object = |((index, sub), kind, _): (Address, u8, u32)| {
        let (name, access) = ("ParameterName=Value", "AccessType=rw");
        format!("[{index:04X}sub{sub:X}]\n{name}\nDataType={kind}\n{access}\n")
    };
    let eds = Eds::parse(&OBJECTS.map(object).concat());
    let mut device = Device::new(is_faulty);
    let mut bench = Bench::new(&mut device, &eds, NODE);
    let mut report = Report::new("device");
    let wanted = ["Guarding", "Heartbeat versus", "Synchronization", "State"].map(str::to_owned);
    conformance::run(&mut bench, APPLICATION_LAYER, &wanted, &mut report, |_| ()).expect("a line");
    let others = report.findings.into_iter().filter(|finding| finding.outcome != Outcome::Passed);
    others.map(|finding| finding.number).collect()
}

#[test]
fn every_case_of_guarding_and_of_the_sync_producer_passes_on_a_device_that_has_them() {
    // The device has no TPDO.
    assert_eq!(not_passed(false), ["Synchronization 03"]);
}

#[test]
fn a_device_that_breaks_their_rules_is_found() {
    let versus = |place| format!("Heartbeat versus guarding {place}");
    let expected = [
        "Synchronization 03".into(),
        "Synchronization 07".into(),
        "Synchronization 08".into(),
        "Guarding 03".into(),
        versus("05"),
        versus("07"),
        "State 04".into(),
    ];
    assert_eq!(not_passed(true), expected);
}
