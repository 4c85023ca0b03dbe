//! The cases of services that no node of this repository has, on a small device: node guarding, the SYNC producer, TPDOs
//! by remote frames, further SDO channels, and sub-index FFh.

use std::{
    collections::{BTreeMap, VecDeque},
    time::{Duration, Instant},
};

use can_bus::{
    adapter::{Adapter, Mode, Received},
    stop::Stop,
};
use canopen_node::{BitRate, Frame};
use conformance::{APPLICATION_LAYER, Address, Bench, Line, Outcome, Report, eds::Eds, ms};

use crate::{has_failed, numbers};

const NODE: u8 = 5;
const PRE_OPERATIONAL: u8 = 127;
const STOPPED: u8 = 4;
const OPERATIONAL: u8 = 5;
/// The objects with their data types and their defaults.
const OBJECTS: [(Address, u8, u32); 16] = [
    ((0x1000, 0), 7, 0),
    ((0x1005, 0), 7, 0x80),
    ((0x1006, 0), 7, 5_000),
    ((0x100C, 0), 6, 0),
    ((0x100D, 0), 5, 0),
    ((0x1010, 1), 7, 1),
    ((0x1011, 1), 7, 1),
    ((0x1014, 0), 7, 0x85),
    ((0x1017, 0), 6, 0),
    ((0x1019, 0), 5, 0),
    ((0x1201, 1), 7, 0x8000_0000),
    ((0x1280, 1), 7, 0x8000_0000),
    ((0x1800, 1), 7, 0x185),
    ((0x1800, 2), 5, 254),
    ((0x1A00, 0), 5, 1),
    ((0x1A00, 1), 7, 0x6000_0108),
];

type Objects = BTreeMap<Address, u32>;

/// What is wrong with a device.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Fault {
    None,
    /// No toggle bit of guarding or of a segment is right, guarding goes on beside the heartbeat, counters begin at 0,
    /// SYNC is sent in NMT state stopped, sub-index FFh is 0, a reset brings no COB-ID back.
    Rules,
    /// It produces no SYNC, no TPDO and no heartbeat, and answers no remote frame.
    Silent,
    /// It answers every remote frame, sends a heartbeat of its own time, and SYNC always with a counter.
    Talkative,
    /// It refuses to read or write 100Ch, 100Dh and 1017h.
    Locked,
}

struct Device {
    start: Instant,
    now: Duration,
    objects: Objects,
    stored: Objects,
    fault: Fault,
    /// The object of a download in segments or of a block download, and the segment of the latter.
    download: Option<(Address, [u8; 2])>,
    next_tpdo: Duration,
    /// Since the last TPDO.
    syncs: u32,
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
    fn new(fault: Fault) -> Self {
        Self {
            start: Instant::now(),
            now: Duration::ZERO,
            objects: defaults(),
            stored: defaults(),
            fault,
            download: None,
            next_tpdo: Duration::ZERO,
            syncs: 0,
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
        let fresh = Self::new(self.fault);
        let (now, stored) = (self.now, std::mem::take(&mut self.stored));
        let mut objects = stored.clone();
        if self.fault == Fault::Rules {
            objects.insert((0x1201, 1), self.objects[&(0x1201, 1)]);
            objects.insert((0x1280, 1), 0);
        }
        *self = Self { now, objects, stored, ..fresh };
        self.transmit(0x705, &[0]);
    }

    /// Handles a message of a download in segments or of a block download; returns whether it is one.
    fn transfer(&mut self, request: &[u8]) -> bool {
        let address = (u16::from_le_bytes([request[1], request[2]]), request[3]);
        let is_known = self.objects.contains_key(&address);
        let wrong = u8::from(self.fault == Fault::Rules) << 4;
        match (request[0], self.download) {
            (0x21, _) if is_known && !self.is_locked(address) => {
                self.download = Some((address, [0; 2]));
                self.transmit(0x585, &[0x60, request[1], request[2], request[3], 0, 0, 0, 0]);
            }
            (0xC2 | 0xC6, _) if is_known && !self.is_locked(address) => {
                self.download = Some((address, [0; 2]));
                self.transmit(0x585, &[0xA4, request[1], request[2], request[3], 127, 0, 0, 0]);
            }
            (toggle @ 0..=0x1F, Some((address, _))) => {
                self.set(address, [request[1], request[2]]);
                self.transmit(0x585, &[0x20 | (toggle & 0x10) ^ wrong, 0, 0, 0, 0, 0, 0, 0]);
            }
            (0x81, Some((address, _))) => {
                self.download = Some((address, [request[1], request[2]]));
                self.transmit(0x585, &[0xA2, 1, 127, 0, 0, 0, 0, 0]);
            }
            (0xC1..0xE0, Some((address, data))) => {
                self.set(address, data);
                self.transmit(0x585, &[0xA1 ^ wrong, 0, 0, 0, 0, 0, 0, 0]);
            }
            _ => return false,
        }
        true
    }

    fn set(&mut self, address: Address, data: [u8; 2]) {
        self.download = None;
        self.objects.insert(address, u16::from_le_bytes(data).into());
    }

    fn is_locked(&self, (index, _): Address) -> bool {
        self.fault == Fault::Locked && matches!(index, 0x100C | 0x100D | 0x1017)
    }

    fn serve(&mut self, request: &[u8]) {
        if self.transfer(request) {
            return;
        }
        let address = (u16::from_le_bytes([request[1], request[2]]), request[3]);
        let number = u32::from_le_bytes(request[4..].try_into().expect("four bytes"));
        let known = OBJECTS.iter().find(|object| object.0 == address).map(|object| object.1);
        let length = 1 << known.unwrap_or(5).saturating_sub(5);
        let has_period = address == (0x1019, 0) && self.value(0x1006) > 0;
        let (command, answer) = match (request[0] >> 5, known) {
            (2, None) if address == (0x1017, 0xFF) => {
                (0x43, if self.fault == Fault::Rules { 0 } else { 0x0607 })
            }
            _ if self.is_locked(address) => (0x80, 0x0800_0000),
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

    fn has_tpdo(&self) -> bool {
        let is_valid = self.objects[&(0x1800, 1)] >> 31 == 0;
        is_valid && self.state == OPERATIONAL && self.fault != Fault::Silent
    }

    fn handle_sync(&mut self) {
        self.syncs += 1;
        let kind = self.objects[&(0x1800, 2)];
        if self.has_tpdo() && kind <= 240 && self.syncs >= kind {
            self.syncs = 0;
            self.transmit(0x185, &[0]);
        }
    }

    /// Sends what is due.
    fn poll(&mut self) {
        let heartbeat = match self.fault {
            Fault::Silent => 0,
            Fault::Talkative => 70,
            _ => self.value(0x1017),
        };
        let heartbeat = ms(heartbeat.into());
        if !heartbeat.is_zero() && self.now >= self.next_heartbeat {
            self.next_heartbeat = self.now + heartbeat;
            self.transmit(0x705, &[self.state]);
        }
        let period = Duration::from_micros(self.value(0x1006).into());
        let is_in_state = self.state != STOPPED || self.fault == Fault::Rules;
        let produces = self.value(0x1005) >> 30 == 1 && is_in_state && self.fault != Fault::Silent;
        if produces && !period.is_zero() && self.now >= self.next_sync {
            self.next_sync = self.now + period;
            self.counter = self.counter % self.value(0x1019).max(1) as u8 + 1;
            let counter = [self.counter - u8::from(self.fault == Fault::Rules)];
            let has_counter = self.value(0x1019) > 0 || self.fault == Fault::Talkative;
            self.transmit(0x080, &counter[..usize::from(has_counter)]);
        }
        let is_event_driven = self.objects[&(0x1800, 2)] >= 254;
        if self.has_tpdo() && is_event_driven && self.now >= self.next_tpdo {
            self.next_tpdo = self.now + ms(300);
            self.transmit(0x185, &[0]);
        }
        if self.life_end.take_if(|end| self.now >= *end).is_some() {
            self.transmit(0x085, &[0x30, 0x81, 0x11, 0, 0, 0, 0, 0]);
        }
    }
}

impl Adapter for Device {
    fn open(&mut self, _: BitRate, _: Mode) -> Result<(), Stop> {
        Ok(())
    }

    fn close(&mut self) -> Result<(), Stop> {
        Ok(())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Stop> {
        match (frame.cob_id(), frame.data()) {
            (0x000, [0x81 | 0x82, _]) => self.reset(),
            (0x000, [1, _]) => self.state = OPERATIONAL,
            (0x000, [2, _]) => self.state = STOPPED,
            (0x000, [0x80, _]) => self.state = PRE_OPERATIONAL,
            (0x080, _) => self.handle_sync(),
            (0x605, request) if self.state != STOPPED => self.serve(request),
            _ => {}
        }
        Ok(())
    }

    fn receive(&mut self, wait: Duration) -> Result<Option<Received>, Stop> {
        let until = self.now + wait;
        while self.sent.is_empty() && self.now < until {
            self.now += ms(1);
            self.poll();
        }
        let (at, here) = (self.now, self.now());
        Ok(self.sent.pop_front().map(|frame| Received { frame, at, here }))
    }

    fn now(&self) -> Instant {
        self.start + self.now
    }

    fn description(&self) -> String {
        String::new()
    }

    fn send_remote(&mut self, cob_id: u16, _: u8) -> Result<bool, Stop> {
        let is_guarded = self.value(0x1017) == 0 || self.fault == Fault::Rules;
        if self.fault == Fault::Talkative {
            self.transmit(cob_id, &[0]);
        } else if cob_id == 0x185 && self.has_tpdo() {
            self.transmit(0x185, &[0]);
        } else if cob_id == 0x705 && is_guarded && self.fault != Fault::Silent {
            self.transmit(0x705, &[self.state | self.toggle]);
            self.toggle ^= if self.fault == Fault::Rules { 0 } else { 0x80 };
            let life = self.value(0x100C) * self.value(0x100D);
            self.life_end = (life > 0).then(|| self.now + ms(life.into()));
        }
        Ok(true)
    }
}

/// The cases that the device is for.
const WANTED: &str = "SDO 14, SDO 20, SDO 24, SDO 29, SDO 30, PDO 03, PDO 09, PDO 15, OD 05, Guarding, Heartbeat versus, \
    Synchronization, State, Transition 02";

/// The cases that fail on a device with a fault.
const FOUND_BY: [(Fault, &str); 4] = [
    (
        Fault::Rules,
        "SDO 14 20 24 29 30, OD 5, Synchronization 7 8, Guarding 3, Heartbeat versus guarding 5 7, \
         State 1 4",
    ),
    (
        Fault::Silent,
        "PDO 3, Synchronization 2 3 6 7 8, Guarding 2 3 6, Heartbeat versus guarding 3 4 5 6 7, \
         State 1 2 3 4, Transition 2",
    ),
    (
        Fault::Talkative,
        "PDO 9 15, Synchronization 6, Guarding 2 3 4 6, Heartbeat versus guarding 2 5 7",
    ),
    (
        Fault::Locked,
        "SDO 14 20 24, Guarding 1 2 3 4 5 6, Heartbeat versus guarding 1 2 3 4 5 6 7, State 1 2 3 4, \
         Transition 2",
    ),
];

/// The numbers and the outcomes of the cases.
fn outcomes(fault: Fault) -> impl Iterator<Item = (String, Outcome)> {
    let object = |((index, sub), kind, _): (Address, u8, u32)| {
        let (name, access) = ("ParameterName=Value", "AccessType=rw");
        format!("[{index:04X}sub{sub:X}]\n{name}\nObjectType=7\nDataType={kind}\n{access}\n")
    };
    let eds = Eds::parse(&OBJECTS.map(object).concat());
    let mut device = Device::new(fault);
    let mut bench = Bench::new(Line::Adapter(&mut device), &eds, NODE);
    let mut report = Report::new("device");
    let wanted: Vec<_> = WANTED.split(", ").map(str::to_owned).collect();
    conformance::run(&mut bench, APPLICATION_LAYER, &wanted, &mut report, |_| ()).expect("a line");
    report.findings.into_iter().map(|finding| (finding.number, finding.outcome))
}

#[test]
fn every_case_of_these_services_passes_on_a_device_that_has_them() {
    let others = outcomes(Fault::None).filter(|(_, outcome)| *outcome != Outcome::Passed);
    assert_eq!(others.map(|(number, _)| number).collect::<Vec<_>>(), [""; 0]);
}

#[test]
fn a_device_that_breaks_their_rules_is_found() {
    for (fault, found_by) in FOUND_BY {
        let failed = outcomes(fault).filter(|(_, outcome)| has_failed(outcome));
        let failed: Vec<String> = failed.map(|(number, _)| number).collect();
        let expected: Vec<String> = numbers(found_by).collect();
        assert_eq!(failed, expected);
    }
}

/// The cases that fail on one of the devices.
pub fn seen_to_fail() -> impl Iterator<Item = String> {
    FOUND_BY.iter().flat_map(|(_, found_by)| numbers(found_by))
}
