//! A controller for tests that sends queued frames and records its events.

use std::collections::VecDeque;

use emulator::{
    Time,
    can::{BitSegments, Bus, Clock, Controller, ErrorKind, Event, Frame, Id, Mode, Station},
};

/// 1 Mbit/s at 32 MHz with the sample point at 87.5 %; other rates by prescaler.
pub const MEGABIT: BitSegments =
    BitSegments { prescaler: 2, segment_1: 13, segment_2: 2, jump_width: 1 };

/// A controller that sends queued frames and records its events.
pub struct Node {
    pub controller: Controller,
    pub queue: VecDeque<Frame>,
    pub log: Vec<(Time, Event)>,
}

impl Node {
    pub fn new(ppm: i32, bit_timing: BitSegments) -> Self {
        let mut node = Self::stopped(ppm, bit_timing);
        node.controller.start(Time::ZERO);
        node
    }

    pub fn stopped(ppm: i32, bit_timing: BitSegments) -> Self {
        let controller = Controller::new(Clock { hz: 32_000_000, ppm }, bit_timing);
        Self { controller, queue: VecDeque::new(), log: Vec::new() }
    }

    pub fn with_mode(mode: Mode) -> Self {
        let mut node = Self::stopped(0, MEGABIT);
        node.controller.configure(MEGABIT, mode);
        node.controller.start(Time::ZERO);
        node
    }

    pub fn send(&mut self, frame: Frame) {
        self.queue.push_back(frame);
        self.controller.offer(self.queue.front().copied(), self.controller.now());
    }

    pub fn received(&self) -> Vec<Frame> {
        self.log
            .iter()
            .filter_map(
                |(_, event)| if let Event::Received(frame) = event { Some(*frame) } else { None },
            )
            .collect()
    }

    pub fn errors(&self) -> Vec<(ErrorKind, bool)> {
        let error = |event: &Event| match *event {
            Event::Error { kind, transmitting } => Some((kind, transmitting)),
            _ => None,
        };
        self.log.iter().filter_map(|(_, event)| error(event)).collect()
    }

    pub fn transmitted(&self) -> Vec<(Time, Time)> {
        let span = |event: &Event| match *event {
            Event::Transmitted { start, end, .. } => Some((start, end)),
            _ => None,
        };
        self.log.iter().filter_map(|(_, event)| span(event)).collect()
    }

    pub fn time_of(&self, wanted: Event) -> Time {
        self.log.iter().find(|(_, event)| *event == wanted).expect("no such event").0
    }

    pub fn tec(&self) -> u16 {
        self.controller.counters().transmit
    }

    pub fn rec(&self) -> u16 {
        self.controller.counters().receive
    }
}

impl Station for Node {
    fn controller(&mut self) -> &mut Controller {
        &mut self.controller
    }

    fn handle(&mut self, event: &Event, now: Time) -> bool {
        self.log.push((now, *event));
        if matches!(event, Event::Transmitted { .. }) {
            self.queue.pop_front();
            self.controller.offer(self.queue.front().copied(), now);
        }
        false
    }
}

/// Runs the bus for a duration.
pub fn run<const N: usize>(bus: &mut Bus, nodes: [&mut Node; N], span: Time) {
    let until = bus.now() + span;
    bus.advance(until, &mut nodes.map(|node| node as &mut dyn Station), &mut |_, _, _| {});
}

pub fn standard(id: u16, payload: &[u8]) -> Frame {
    Frame::data(Id::Standard(id), payload)
}

/// The bit timing for 1 Mbit/s or less.
pub fn at(kilobits: u16) -> BitSegments {
    BitSegments { prescaler: 2 * (1000 / kilobits), ..MEGABIT }
}
