//! A bus within the process, in virtual time: boards with a node, an LSS master, and frames that are lost, delayed or
//! doubled.

use std::{collections::BTreeMap, convert::Infallible};

use canopen_node::{
    BitRate, Frame, Instant,
    lss::{self, Address},
};
use lss_master::{Bus, Error, Master, Procedure};

use super::{
    node_rig::{ADDRESS, NodeRig},
    random::Random,
};

/// The bits of a frame with eight bytes, intermission included, without stuff bits and with the most.
const FRAME_BITS: std::ops::Range<u64> = 111..136;

/// What happens to frames; each is a probability of 1 in so many, 0: never.
#[derive(Clone, Copy, Debug, Default)]
pub struct Faults {
    /// A slave misses a request, or the master an answer.
    pub lost: u64,
    /// The master receives an answer twice.
    pub doubled: u64,
    /// An answer is late by up to so many microseconds.
    pub late: u64,
    pub late_us: u64,
}

/// A board on the bus.
pub struct Slave {
    pub rig: NodeRig,
    /// The time to its answer.
    pub answer_us: u64,
    /// Whether it misses a request that comes in the time to the answer to the last one.
    pub loses_requests: bool,
    /// The number of requests on the bus after which it has no connection.
    pub leaves_after: u64,
    ready_at: u64,
}

/// The bus.
pub struct RigBus {
    pub slaves: Vec<Slave>,
    pub faults: Faults,
    /// The master's bit rate.
    pub bit_rate: BitRate,
    /// The number of requests.
    pub requests: u64,
    random: Random,
    now: u64,
    free_at: u64,
    /// By time, at one time in a random order.
    events: BTreeMap<(u64, u64), Event>,
    /// The latest frame that a board wanted to send, and when: equal frames at one time are one.
    latest: Option<(u64, Frame)>,
}

enum Event {
    /// The end of a request.
    Request(Frame),
    /// A slave wants to send.
    Answer(Frame),
    /// The end of a slave's frame.
    Received(Frame),
}

impl RigBus {
    /// A bus at the boards' bit rate. They answer within 10 us.
    pub fn new(rigs: impl IntoIterator<Item = NodeRig>, random: Random) -> Self {
        let slave = |rig| Slave {
            rig,
            answer_us: 10,
            loses_requests: false,
            leaves_after: u64::MAX,
            ready_at: 0,
        };
        Self {
            slaves: rigs.into_iter().map(slave).collect(),
            faults: Faults::default(),
            bit_rate: BitRate::Kbit1000,
            requests: 0,
            random,
            now: 0,
            free_at: 0,
            events: BTreeMap::new(),
            latest: None,
        }
    }

    /// Microseconds since the beginning.
    pub fn now(&self) -> u64 {
        self.now
    }

    /// Carries out a procedure of the master.
    pub fn run<P: Procedure>(
        &mut self,
        master: &mut Master,
        procedure: P,
    ) -> Result<P::Output, Error> {
        let Ok(result) = lss_master::run(self, master, procedure);
        result
    }

    /// The boards in LSS configuration state.
    pub fn in_configuration(&mut self) -> usize {
        // The last request may still be under way.
        self.receive(self.free_at);
        self.slaves.iter_mut().filter_map(|slave| slave.rig.inquired_node_id()).count()
    }

    fn happens(&mut self, one_in: u64) -> bool {
        one_in > 0 && self.random.one_in(one_in)
    }

    /// The end of a frame that is sent as soon as the bus is free.
    fn end_of_frame(&mut self) -> u64 {
        let bits = self.random.within(FRAME_BITS);
        self.free_at =
            self.now.max(self.free_at) + bits * 1_000 / u64::from(self.bit_rate.kbit_per_s());
        self.free_at
    }

    fn at(&mut self, time: u64, event: Event) {
        let order = self.random.u64();
        self.events.insert((time, order), event);
    }

    fn send(&mut self, request: &Frame) {
        assert_eq!(request.cob_id(), lss::REQUEST_COB_ID);
        self.requests += 1;
        let end = self.end_of_frame();
        self.at(end, Event::Request(*request));
    }

    /// The next frame that the master receives until then.
    fn receive(&mut self, until: u64) -> Option<Frame> {
        while let Some(entry) = self.events.first_entry()
            && entry.key().0 <= until
        {
            let ((time, _), event) = entry.remove_entry();
            self.now = self.now.max(time);
            match event {
                Event::Request(request) => self.deliver(&request),
                Event::Answer(answer) => self.answer(answer),
                Event::Received(frame) => return Some(frame),
            }
        }
        self.now = until;
        None
    }

    /// Gives all boards a request.
    fn deliver(&mut self, request: &Frame) {
        for number in 0..self.slaves.len() {
            let is_lost = self.happens(self.faults.lost);
            let is_late = self.happens(self.faults.late);
            let late_us = if is_late { self.random.within(0..self.faults.late_us) } else { 0 };
            let (now, bit_rate) = (self.now, self.bit_rate);
            let slave = &mut self.slaves[number];
            slave.rig.pass_us(now - slave.rig.now());
            let is_busy = slave.loses_requests && now < slave.ready_at;
            if is_lost
                || is_busy
                || slave.leaves_after < self.requests
                || slave.rig.bit_rate() != bit_rate
            {
                continue;
            }
            let time = now + slave.answer_us + late_us;
            slave.ready_at = time;
            for answer in slave.rig.receive(request).0 {
                self.at(time, Event::Answer(answer));
            }
        }
    }

    /// Puts a board's frame on the bus.
    fn answer(&mut self, answer: Frame) {
        if let Some((time, other)) = self.latest
            && (time, other.cob_id()) == (self.now, answer.cob_id())
        {
            // After a lost request two slaves may be in LSS configuration state.
            assert!(answer == other || self.faults.lost > 0, "answers at once are identical");
            return;
        }
        self.latest = Some((self.now, answer));
        let end = self.end_of_frame();
        if !self.happens(self.faults.lost) {
            self.at(end, Event::Received(answer));
        }
        if self.happens(self.faults.doubled) {
            let again = self.end_of_frame();
            self.at(again, Event::Received(answer));
        }
    }
}

impl Bus for RigBus {
    type Error = Infallible;

    fn now(&self) -> Instant {
        Instant::from_micros(self.now as u32)
    }

    fn send(&mut self, request: &Frame) -> Result<(), Infallible> {
        self.send(request);
        Ok(())
    }

    fn receive(
        &mut self,
        until: Instant,
        mut take: impl FnMut(&Frame, Instant),
    ) -> Result<(), Infallible> {
        let wait = until.micros_after(Bus::now(self));
        if let Some(answer) = self.receive(self.now + u64::from(wait)) {
            take(&answer, Bus::now(self));
        }
        Ok(())
    }

    fn set_bit_rate(&mut self, bit_rate: BitRate) -> Result<(), Infallible> {
        self.bit_rate = bit_rate;
        Ok(())
    }
}

/// Addresses that share parts and differ in single bits, and the extremes; at least three.
pub fn neighbours(random: &mut Random, count: usize) -> Vec<Address> {
    let mut all = vec![ADDRESS.into(), [0; 4], [u32::MAX; 4]];
    while all.len() < count {
        let mut parts = random.pick(&all);
        let part = random.within(0..4) as usize;
        parts[part] =
            if random.one_in(2) { parts[part] ^ 1 << random.within(0..32) } else { random.u32() };
        if !all.contains(&parts) {
            all.push(parts);
        }
    }
    all.into_iter().map(Address::from).collect()
}
