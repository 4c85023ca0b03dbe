//! A computer's CAN adapter: a controller with queues instead of mailboxes.

use std::collections::VecDeque;

use super::{BitSegments, Clock, Controller, Event, Frame, Level, Mode, Station};
use crate::Time;

/// Time quanta in a bit of an adapter set by bit rate. Two of them follow the sample point, which is at 87.5 %.
const QUANTA: u32 = 16;

/// A CAN adapter with unbounded queues. It repeats a frame until it is sent and recovers from
/// bus-off by itself.
pub struct Adapter {
    controller: Controller,
    ppm: i32,
    bit_timing: BitSegments,
    mode: Mode,
    open: bool,
    to_send: VecDeque<Frame>,
    received: VecDeque<(Time, Frame)>,
    errors: u64,
}

impl Adapter {
    /// An open adapter with exactly `bit_rate` bit/s and a sample point at 87.5 %.
    pub fn new(bit_rate: u32) -> Self {
        let (clock, bit_timing) = exact(bit_rate, 0);
        Self::with_timing(clock, bit_timing)
    }

    /// An open adapter with the given clock and bit timing.
    pub fn with_timing(clock: Clock, bit_timing: BitSegments) -> Self {
        let mut controller = Controller::new(clock, bit_timing);
        controller.start(Time::ZERO);
        Self {
            controller,
            ppm: clock.ppm,
            bit_timing,
            mode: Mode::default(),
            open: true,
            to_send: VecDeque::new(),
            received: VecDeque::new(),
            errors: 0,
        }
    }

    pub fn send(&mut self, frame: Frame) {
        self.to_send.push_back(frame);
        self.offer();
    }

    /// The oldest unread frame, with the time at which it became valid.
    pub fn receive(&mut self) -> Option<(Time, Frame)> {
        self.received.pop_front()
    }

    /// The number of frames waiting to be sent, including the one under way.
    pub fn unsent(&self) -> usize {
        self.to_send.len()
    }

    pub fn errors(&self) -> u64 {
        self.errors
    }

    /// Leaves the bus at once, even within a frame, and clears the transmit queue and the error counters.
    pub fn close(&mut self) {
        self.open = false;
        self.to_send.clear();
        self.controller.reset();
    }

    /// Closes the adapter, then joins the bus to send, receive and acknowledge.
    pub fn open(&mut self) {
        self.reopen(Mode::default());
    }

    /// Closes the adapter, then joins the bus to receive without driving the wire.
    pub fn listen_only(&mut self) {
        self.reopen(Mode { silent: true, loopback: false });
    }

    /// Changes to exactly `bit_rate` bit/s, sample point 87.5 %; an open adapter leaves the bus and joins again.
    pub fn set_bit_rate(&mut self, bit_rate: u32) {
        let (clock, bit_timing) = exact(bit_rate, self.ppm);
        self.controller.set_clock(clock);
        self.bit_timing = bit_timing;
        if self.open {
            self.reopen(self.mode);
        }
    }

    /// Joins a bus whose time is `now`.
    pub(crate) fn plug_in(&mut self, now: Time, wire: Level) {
        let waiting = std::mem::take(&mut self.to_send);
        self.controller.settle(now, wire);
        if self.open {
            self.reopen(self.mode);
        }
        self.to_send = waiting;
        self.offer();
    }

    fn reopen(&mut self, mode: Mode) {
        self.close();
        self.open = true;
        self.mode = mode;
        self.controller.configure(self.bit_timing, mode);
        self.controller.start(self.controller.now());
    }

    fn offer(&mut self) {
        let now = self.controller.now();
        self.controller.offer(self.to_send.front().copied(), now);
    }
}

impl Station for Adapter {
    fn controller(&mut self) -> &mut Controller {
        &mut self.controller
    }

    fn handle(&mut self, event: &Event, now: Time) -> bool {
        match event {
            Event::Transmitted { .. } => {
                self.to_send.pop_front();
                self.offer();
            }
            Event::Received(frame) => {
                self.received.push_back((now, *frame));
                return true;
            }
            Event::Error { .. } => self.errors += 1,
            Event::BusOff => self.controller.recover(now),
            _ => {}
        }
        false
    }
}

fn exact(bit_rate: u32, ppm: i32) -> (Clock, BitSegments) {
    let bit_timing = BitSegments { prescaler: 1, segment_1: 13, segment_2: 2, jump_width: 2 };
    (Clock { hz: bit_rate * QUANTA, ppm }, bit_timing)
}
