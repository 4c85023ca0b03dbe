//! The bus within the process, in virtual time, as a master with a CAN adapter sees it: slaves with and without the
//! faults that people meet, frames that are lost, late or doubled, cut power and another master.

#[cfg(feature = "adapter")]
mod adapter;
mod defect;
mod slave;
#[cfg(feature = "adapter")]
mod slcan;

use std::{
    collections::{BTreeMap, VecDeque},
    convert::Infallible,
};

use canopen_node::{
    Application, BitRate, BusEvent, Frame, Instant,
    application::NoApplication,
    lss::{self, REQUEST_COB_ID, RESPONSE_COB_ID},
};
use lss_master::{Error, Master, Procedure};

use crate::{node_rig::NodeRig, random::Random};

#[cfg(feature = "adapter")]
pub use adapter::BusAdapter;
pub use defect::Defect;
pub use slave::{Habits, Happening, Slave};
#[cfg(feature = "adapter")]
pub use slcan::Firmware;

/// No time that comes.
const NEVER: u64 = u64::MAX;
/// The bits of a frame without data, intermission included, and of a byte; with half of the most stuff bits.
const FRAME_BITS: u64 = 51;
const BYTE_BITS: u64 = 9;

/// What happens to frames; each is a probability of 1 in so many, 0: never.
#[derive(Clone, Copy, Debug, Default)]
pub struct Faults {
    /// A slave misses a frame, or the tool does.
    pub lost: u64,
    /// The tool receives a frame twice.
    pub doubled: u64,
    /// An LSS answer is late by up to so many microseconds.
    pub late: u64,
    pub late_us: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Source {
    Tool,
    OtherMaster,
    Slave(usize),
}

/// A frame on its way.
struct Flight {
    frame: Frame,
    source: Source,
    rate: BitRate,
    end: u64,
}

/// The bus.
pub struct SlaveBus<A: Application = NoApplication> {
    pub slaves: Vec<Slave<A>>,
    pub faults: Faults,
    /// The number of frames that the tool has sent.
    pub requests: u64,
    /// Those of different content that wanted the bus at one time with one COB-ID.
    pub collisions: u64,
    random: Random,
    now: u64,
    free_at: u64,
    /// By time and in their order.
    waiting: BTreeMap<(u64, u64), (Source, Frame)>,
    count: u64,
    flight: Option<Flight>,
    happenings: BTreeMap<(u64, u64), (usize, Happening)>,
    /// The bit rate of the tool's adapter.
    pub rate: BitRate,
    is_open: bool,
    may_send: bool,
    received: VecDeque<(u64, Frame)>,
    is_unacknowledged: bool,
}

impl<A: Application + Clone> SlaveBus<A> {
    pub fn new(slaves: impl IntoIterator<Item = (NodeRig<A>, Habits)>, random: Random) -> Self {
        let mut bus = Self {
            slaves: Vec::new(),
            faults: Faults::default(),
            requests: 0,
            collisions: 0,
            random,
            now: 0,
            free_at: 0,
            waiting: BTreeMap::new(),
            count: 0,
            flight: None,
            happenings: BTreeMap::new(),
            rate: BitRate::Kbit125,
            is_open: false,
            may_send: false,
            received: VecDeque::new(),
            is_unacknowledged: false,
        };
        bus.slaves.extend(slaves.into_iter().map(|(rig, habits)| Slave::new(rig, habits)));
        (0..bus.slaves.len()).for_each(|number| bus.collect(number));
        bus
    }

    /// Microseconds since the beginning.
    pub fn now(&self) -> u64 {
        self.now
    }

    /// Lets something happen to a slave at a time.
    pub fn plan(&mut self, at: u64, slave: usize, happening: Happening) {
        self.count += 1;
        self.happenings.insert((at, self.count), (slave, happening));
    }

    /// Forgets all that was planned, and gives each slave its power and its connection.
    pub fn calm(&mut self) {
        self.happenings.clear();
        for number in 0..self.slaves.len() {
            if !self.slaves[number].is_powered {
                self.happen(number, Happening::PowerOn);
            }
            self.happen(number, Happening::PlugIn);
        }
    }

    /// Puts the tool's adapter on the bus at a bit rate, and drops its waiting frames.
    pub fn open(&mut self, rate: BitRate, may_send: bool) {
        self.waiting.retain(|_, (source, _)| *source != Source::Tool);
        self.received.clear();
        (self.rate, self.may_send, self.is_open) = (rate, may_send, true);
    }

    /// Whether the tool's adapter may send and acknowledge.
    pub fn may_send(&self) -> bool {
        self.may_send
    }

    /// The tool sends a frame.
    pub fn send(&mut self, frame: Frame) {
        self.requests += 1;
        self.enqueue(self.now, Source::Tool, frame);
    }

    /// Another master sends a frame at a time.
    pub fn send_from_another_master(&mut self, at: u64, frame: Frame) {
        self.enqueue(at, Source::OtherMaster, frame);
    }

    /// The time at which something happens next, in microseconds since the beginning; `u64::MAX`: nothing does.
    pub fn next_at(&self) -> u64 {
        let due = self.next_slave().map_or(NEVER, |(at, _)| at);
        let flight = self.flight.as_ref().map_or_else(|| self.next_start(), |on| on.end);
        self.next_delivery().min(self.next_happening()).min(due).min(flight)
    }

    fn next_delivery(&self) -> u64 {
        self.received.front().map_or(NEVER, |(at, _)| *at)
    }

    fn next_happening(&self) -> u64 {
        self.happenings.keys().next().map_or(NEVER, |(at, _)| *at)
    }

    /// Lets time pass; returns a frame that the tool receives, with the time of its end.
    pub fn run(&mut self, until: u64) -> Option<(u64, Frame)> {
        loop {
            let next = self.next_at();
            if next > until {
                self.now = self.now.max(until);
                return None;
            }
            self.now = self.now.max(next);
            if self.next_delivery() == next {
                return self.received.pop_front();
            } else if self.next_happening() == next {
                let (_, (slave, happening)) = self.happenings.pop_first()?;
                self.happen(slave, happening);
            } else if let Some((due, number)) = self.next_slave()
                && due == next
            {
                self.wake(number);
            } else if let Some(flight) = self.flight.take() {
                self.land(flight);
            } else {
                self.start();
            }
        }
    }

    /// Lets time pass, and drops what the tool receives.
    pub fn pass_us(&mut self, us: u64) {
        let until = self.now + us;
        while self.run(until).is_some() {}
    }

    /// Carries out a procedure of the master, whose adapter is the tool's.
    pub fn carry_out<P: Procedure>(
        &mut self,
        master: &mut Master,
        procedure: P,
    ) -> Result<P::Output, Error> {
        let Ok(result) = lss_master::run(self, master, procedure);
        // After a lost request two slaves may be in LSS configuration state.
        assert!(self.collisions == 0 || self.faults.lost > 0, "answers at once are identical");
        result
    }

    /// The number of slaves in LSS configuration state.
    pub fn in_configuration(&mut self) -> usize {
        // The last request may still be under way.
        self.pass_us(10_000);
        let numbers = 0..self.slaves.len();
        let is_in_it =
            |number: &usize| self.beside_bus(*number, NodeRig::is_in_configuration_state);
        numbers.filter(is_in_it).count()
    }

    /// Does something with a slave beside the bus, on which nothing is sent for it.
    pub fn beside_bus<T>(&mut self, number: usize, work: impl FnOnce(&mut NodeRig<A>) -> T) -> T {
        self.on_bus(number, |rig| {
            let outcome = work(rig);
            rig.take_actions();
            outcome
        })
    }

    /// Does something with a slave, which sends what follows from it.
    pub fn on_bus<T>(&mut self, number: usize, work: impl FnOnce(&mut NodeRig<A>) -> T) -> T {
        let slave = &mut self.slaves[number];
        if slave.is_powered {
            slave.catch_up(self.now);
            self.collect(number);
        }
        let outcome = work(&mut self.slaves[number].rig);
        self.collect(number);
        outcome
    }

    fn next_slave(&self) -> Option<(u64, usize)> {
        self.slaves.iter().enumerate().map(|(number, slave)| (slave.due, number)).min()
    }

    fn next_start(&self) -> u64 {
        self.waiting.keys().next().map_or(NEVER, |(at, _)| (*at).max(self.free_at))
    }

    fn enqueue(&mut self, at: u64, source: Source, frame: Frame) {
        self.count += 1;
        self.waiting.insert((at, self.count), (source, frame));
    }

    /// Puts the most urgent frame on the bus. The same frames of several slaves are one.
    fn start(&mut self) {
        let now = self.now;
        // Each sender keeps the order of its frames.
        let mut senders = Vec::new();
        let mut heads: Vec<((u64, u64), Source, Frame)> = Vec::new();
        for (key, (source, frame)) in self.waiting.range(..=(now, u64::MAX)) {
            if !senders.contains(source) {
                senders.push(*source);
                heads.push((*key, *source, *frame));
            }
        }
        let first = heads.iter().min_by_key(|((_, count), _, frame)| (frame.cob_id(), *count));
        let Some(&(key, source, frame)) = first else { return };
        self.waiting.remove(&key);
        if is_slave(source) {
            for (key, other, waiting) in heads {
                if other == source || waiting.cob_id() != frame.cob_id() {
                    continue;
                }
                match waiting == frame && is_slave(other) {
                    true => drop(self.waiting.remove(&key)),
                    false => self.collisions += 1,
                }
            }
        }
        let rate = match source {
            Source::Tool if !self.may_send => return,
            Source::Tool | Source::OtherMaster => self.rate,
            Source::Slave(number) => {
                let slave = &self.slaves[number];
                if !slave.is_powered || !slave.is_connected || slave.rig.is_quiet {
                    return;
                }
                slave.rig.bit_rate()
            }
        };
        let end = now + span(&frame, rate);
        self.free_at = end;
        self.flight = Some(Flight { frame, source, rate, end });
    }

    /// Delivers a frame at its end.
    fn land(&mut self, flight: Flight) {
        let Flight { frame, source, rate, end } = flight;
        let mut is_acknowledged = self.may_send && rate == self.rate && source != Source::Tool;
        for number in 0..self.slaves.len() {
            let slave = &mut self.slaves[number];
            let is_gone = !slave.is_connected || slave.habits.leaves_after < self.requests;
            if source == Source::Slave(number) || !slave.is_powered || is_gone {
                continue;
            }
            let receives = slave.rig.node.receives();
            if slave.rig.bit_rate() != rate {
                if receives.all {
                    slave.catch_up(end);
                    slave.rig.see(BusEvent::Error);
                    self.collect(number);
                }
                continue;
            }
            is_acknowledged |= !slave.rig.node.is_listening();
            if !receives.contains(frame.cob_id()) || self.happens(self.faults.lost) {
                continue;
            }
            self.deliver(number, &frame);
        }
        let hears = self.is_open && self.rate == rate && source != Source::Tool;
        if hears && !self.happens(self.faults.lost) {
            self.received.push_back((end, frame));
            if self.happens(self.faults.doubled) {
                self.free_at = end + span(&frame, rate);
                self.received.push_back((self.free_at, frame));
            }
        }
        self.is_unacknowledged |= source == Source::Tool && !is_acknowledged;
    }

    fn happens(&mut self, one_in: u64) -> bool {
        one_in > 0 && self.random.one_in(one_in)
    }

    fn deliver(&mut self, number: usize, frame: &Frame) {
        if self.misbehaves(number, frame) {
            return;
        }
        let now = self.now;
        let slave = &mut self.slaves[number];
        let is_lss = frame.cob_id() == REQUEST_COB_ID;
        if is_lss
            && slave.habits.without.iter().any(|specifier| frame.data().first() == Some(specifier))
        {
            return;
        }
        let is_question = matches!(frame.data().first(), Some(0x4B | 0x51));
        if is_lss && slave.habits.claims_all && is_question {
            let answer_us = self.random.within(slave.habits.answer_us.clone());
            let answer = lss::Response::Identified.to_frame();
            self.enqueue(now + answer_us, Source::Slave(number), answer);
            return;
        }
        if is_lss && slave.habits.poll_us > 0 {
            let next = (now / slave.habits.poll_us + 1) * slave.habits.poll_us;
            slave.held.get_or_insert((next, *frame));
            slave.due = slave.due.min(next);
            return;
        }
        if is_lss && slave.habits.loses_requests {
            if now < slave.ready_at {
                return;
            }
            slave.ready_at = now + slave.habits.answer_us.start;
        }
        self.hand_over(number, frame);
    }

    fn hand_over(&mut self, number: usize, frame: &Frame) {
        let slave = &mut self.slaves[number];
        slave.catch_up(self.now);
        if slave.rig.node.receives().all {
            slave.rig.report(BusEvent::Received);
        }
        slave.rig.receive(frame);
        self.collect(number);
    }

    /// Does what is due in a slave.
    fn wake(&mut self, number: usize) {
        let now = self.now;
        let slave = &mut self.slaves[number];
        let frame = slave.held.take_if(|(at, _)| *at <= now);
        if let Some((_, frame)) = frame {
            self.hand_over(number, &frame);
        }
        let slave = &mut self.slaves[number];
        slave.catch_up(now);
        if slave.stored_at <= now {
            slave.stored_at = NEVER;
            if slave.rig.is_storing() {
                slave.rig.finish_store();
            }
        }
        self.collect(number);
    }

    /// Takes what a slave wants to send, and notes when it acts next.
    fn collect(&mut self, number: usize) {
        let now = self.now;
        let slave = &mut self.slaves[number];
        let Habits { boot_up, answer_bytes, .. } = slave.habits;
        let defect = &mut slave.defect;
        let sent: Vec<Frame> = slave
            .rig
            .take_actions()
            .into_iter()
            .filter_map(|action| match action {
                canopen_node::Action::Transmit(frame, _) => match (frame.cob_id(), frame.data()) {
                    (0x701..=0x77F, [0]) => Frame::new(frame.cob_id(), &[boot_up]),
                    (RESPONSE_COB_ID, data) => Frame::new(RESPONSE_COB_ID, &data[..answer_bytes]),
                    _ => Some(frame),
                },
                _ => None,
            })
            .filter_map(|frame| match defect {
                Some(defect) => defect.alters(frame),
                None => Some(frame),
            })
            .collect();
        if slave.rig.is_storing() && slave.stored_at == NEVER {
            slave.stored_at = now + slave.habits.store_us;
        }
        if !slave.is_powered {
            slave.due = NEVER;
            return;
        }
        let next = slave.rig.us_to_deadline().map_or(NEVER, |us| slave.rig.now() + us);
        let held = slave.held.map_or(NEVER, |(at, _)| at);
        slave.due = next.min(held).min(slave.stored_at);
        for frame in sent {
            let habits = &self.slaves[number].habits;
            let answer_us = match frame.cob_id() {
                RESPONSE_COB_ID => habits.answer_us.clone(),
                _ => habits.other_us.clone(),
            };
            let answer_us = if answer_us.is_empty() { 0 } else { self.random.within(answer_us) };
            let is_late = frame.cob_id() == RESPONSE_COB_ID && self.happens(self.faults.late);
            let late_us = if is_late { self.random.within(0..self.faults.late_us) } else { 0 };
            let slave = &mut self.slaves[number];
            slave.last_answer = slave.last_answer.max(now + answer_us);
            // A late answer may come behind the next one.
            let (at, again_us) = (slave.last_answer + late_us, slave.habits.again_us);
            self.enqueue(at, Source::Slave(number), frame);
            if again_us > 0 && frame.cob_id() == RESPONSE_COB_ID {
                self.enqueue(at + again_us, Source::Slave(number), frame);
            }
        }
    }

    /// Lets something happen to a slave at once.
    pub fn happen(&mut self, number: usize, happening: Happening) {
        let now = self.now;
        let slave = &mut self.slaves[number];
        match happening {
            Happening::PullOut => slave.is_connected = false,
            Happening::PlugIn => slave.is_connected = true,
            Happening::PowerOff => {
                slave.is_powered = false;
                (slave.held, slave.stored_at, slave.due) = (None, NEVER, NEVER);
                self.waiting.retain(|_, (source, _)| *source != Source::Slave(number));
            }
            Happening::PowerOn => {
                slave.catch_up(now);
                slave.rig.take_actions();
                slave.rig.power_cycle();
                slave.is_powered = true;
                self.collect(number);
            }
        }
    }
}

impl<A: Application + Clone> lss_master::Bus for SlaveBus<A> {
    type Error = Infallible;

    fn now(&self) -> Instant {
        Instant::from_micros(self.now as u32)
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Infallible> {
        self.send(*frame);
        Ok(())
    }

    fn receive(
        &mut self,
        until: Instant,
        mut take: impl FnMut(&Frame, Instant),
    ) -> Result<(), Infallible> {
        let wait = until.micros_after(lss_master::Bus::now(self));
        if let Some((_, frame)) = self.run(self.now + u64::from(wait)) {
            take(&frame, lss_master::Bus::now(self));
        }
        Ok(())
    }

    fn set_bit_rate(&mut self, rate: BitRate) -> Result<(), Infallible> {
        self.open(rate, true);
        Ok(())
    }
}

fn is_slave(source: Source) -> bool {
    matches!(source, Source::Slave(_))
}

/// The time that a frame is on the bus, in microseconds.
fn span(frame: &Frame, rate: BitRate) -> u64 {
    (FRAME_BITS + BYTE_BITS * frame.data().len() as u64) * 1_000 / u64::from(rate.kbit_per_s())
}
