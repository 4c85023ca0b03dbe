//! The line between a controller and the wire: its pins, its transceiver, and its faults.

use super::Controller;
use crate::{Time, can::Level};

/// The controller's pins that are connected to its transceiver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pins {
    /// What the transceiver gets to transmit.
    pub transmit: Transmit,
    /// It receives the wire's level, otherwise a dominant level. The manual leaves that open, but no station joins a bus by
    /// a pin that is not connected.
    pub receive: bool,
}

/// What a transmit pin carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Transmit {
    /// The level that the controller drives.
    Controller,
    /// A recessive level: the pin is an input, or a high output.
    Recessive,
    /// A dominant level: the pin is a low output.
    Dominant,
}

/// The connection between a controller and the wire; a reset of the controller does not change it.
#[derive(Debug)]
pub(super) struct Line {
    now: State,
    /// The next state, and the time of the change.
    next: Option<(Time, State)>,
    /// The station is cut off: its transceiver returns only the level that it drives itself.
    cut: bool,
    /// The first sample at or after each of these instants is inverted.
    flips: Vec<Time>,
    /// The transceiver's dominant time-out, and its end for the present level.
    time_out: Option<Time>,
    ends: Option<Time>,
    /// The transceiver does not pass on the present level, which has been dominant for too long.
    is_blocked: bool,
}

#[derive(Clone, Copy, Debug)]
struct State {
    pins: Pins,
    /// The transmit pin is held dominant.
    locked: bool,
}

impl Pins {
    pub const CONNECTED: Self = Self { transmit: Transmit::Controller, receive: true };
}

impl Default for Line {
    fn default() -> Self {
        let now = State { pins: Pins::CONNECTED, locked: false };
        Self {
            now,
            next: None,
            cut: false,
            flips: Vec::new(),
            time_out: None,
            ends: None,
            is_blocked: false,
        }
    }
}

impl Line {
    pub fn next_action(&self) -> Time {
        let change = self.next.map_or(Time::MAX, |(at, _)| at);
        change.min(self.ends.unwrap_or(Time::MAX))
    }

    pub fn act(&mut self, now: Time) {
        if let Some((_, next)) = self.next.take_if(|(at, _)| *at <= now) {
            self.now = next;
        }
        self.is_blocked |= self.ends.take_if(|end| *end <= now).is_some();
    }

    /// Plans a change; an earlier plan takes effect now.
    fn change(&mut self, from: Time, change: impl FnOnce(&mut State)) {
        self.act(Time::MAX);
        let mut next = self.now;
        change(&mut next);
        self.next = Some((from, next));
    }

    /// Follows the level at the transceiver's input. A recessive one ends the time-out.
    fn follow(&mut self, level: Level, now: Time) {
        if level == Level::Recessive {
            (self.ends, self.is_blocked) = (None, false);
        } else if !self.is_blocked && self.ends.is_none() {
            self.ends = self.time_out.map(|time_out| now + time_out);
        }
    }

    /// Clears the state that a reset of the controller clears.
    pub fn reset(&mut self) {
        self.act(Time::MAX);
        self.now.locked = false;
    }

    /// The earliest instant from which a sample is to be inverted.
    pub fn next_flip(&self) -> Option<Time> {
        self.flips.iter().copied().min()
    }

    /// Whether the sample at `now` is to be inverted, which it clears.
    fn take_flip(&mut self, now: Time) -> bool {
        let before = self.flips.len();
        self.flips.retain(|&at| at > now);
        self.flips.len() != before
    }
}

impl Controller {
    /// Lets the transceiver end a dominant level after this time, until the next recessive one. `None`: it never does.
    pub fn set_dominant_time_out(&mut self, time_out: Option<Time>) {
        self.line.time_out = time_out;
    }

    /// Connects the controller's pins to its transceiver, or disconnects them, from `from` on.
    pub fn connect(&mut self, pins: Pins, from: Time) {
        self.line.change(from, |line| line.pins = pins);
    }

    /// Holds the transmit pin dominant from `from` on until the next [`reset`](Self::reset).
    pub fn lock_transmit_pin(&mut self, from: Time) {
        self.line.change(from, |line| line.locked = true);
    }

    /// Cuts the controller off from the wire, or connects it again.
    pub fn cut(&mut self, cut: bool) {
        self.line.cut = cut;
    }

    /// Inverts the first sample at or after `at`.
    pub fn flip(&mut self, at: Time) {
        self.line.flips.push(at);
    }

    /// Follows the level that the controller drives.
    pub(super) fn follow_line(&mut self, now: Time) {
        let level = self.transmitted();
        self.line.follow(level, now);
    }

    /// The level that the wire gets from this controller.
    pub(in crate::can) fn output(&self) -> Level {
        let is_open = self.line.cut || self.line.is_blocked;
        if is_open { Level::Recessive } else { self.transmitted() }
    }

    /// Whether edges of the wire reach the controller.
    pub(super) fn hears_wire(&self) -> bool {
        self.line.now.pins.receive && !self.line.cut
    }

    /// The level at the controller's receive pin.
    pub(super) fn heard(&self, wire: Level) -> Level {
        match &self.line {
            line if !line.now.pins.receive => Level::Dominant,
            line if line.cut => self.transmitted(),
            _ => wire,
        }
    }

    /// The level at a sample point. In silent and in loopback mode the controller hears its own dominant bits
    /// internally, as they do not reach the wire or do not count there.
    pub(super) fn take_sample(&mut self, now: Time, wire: Level) -> Level {
        let level = match self.driven {
            own if self.mode.loopback => own,
            Level::Dominant if self.mode.silent => Level::Dominant,
            _ => self.heard(wire),
        };
        match (self.line.take_flip(now), level) {
            (false, level) => level,
            (true, Level::Dominant) => Level::Recessive,
            (true, Level::Recessive) => Level::Dominant,
        }
    }

    /// The level that reaches the transceiver.
    fn transmitted(&self) -> Level {
        match self.line.now {
            State { pins: Pins { transmit: Transmit::Recessive, .. }, .. } => Level::Recessive,
            State { pins: Pins { transmit: Transmit::Dominant, .. }, .. } => Level::Dominant,
            State { locked: true, .. } => Level::Dominant,
            _ if self.mode.silent => Level::Recessive,
            _ => self.driven,
        }
    }
}
