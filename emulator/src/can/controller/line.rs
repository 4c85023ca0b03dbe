//! The line between a controller and the wire, and what is wrong with it.

use super::Controller;
use crate::{Time, can::Level};

/// Which of a controller's pins lead to its transceiver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pins {
    /// What it drives reaches the wire.
    pub transmit: bool,
    /// It hears the wire. Else it hears a dominant level: a doubtful reading, but nobody joins a
    /// bus by a pin that is not there.
    pub receive: bool,
}

/// How a controller is joined to the wire; no reset of the controller changes that.
#[derive(Debug)]
pub(super) struct Line {
    now: State,
    /// What it will be, and from when on.
    next: Option<(Time, State)>,
    /// The station is cut off: its transceiver returns what it drives itself, and nothing else.
    cut: bool,
    /// The first sample at or after each of these instants is inverted.
    flips: Vec<Time>,
}

#[derive(Clone, Copy, Debug)]
struct State {
    pins: Pins,
    /// The transmit pin is held dominant.
    locked: bool,
}

impl Default for Line {
    fn default() -> Self {
        let now = State { pins: Pins { transmit: true, receive: true }, locked: false };
        Self { now, next: None, cut: false, flips: Vec::new() }
    }
}

impl Line {
    /// When it changes.
    pub fn next_action(&self) -> Time {
        self.next.map_or(Time::MAX, |(at, _)| at)
    }

    /// Changes if that is due.
    pub fn act(&mut self, now: Time) {
        if let Some((_, next)) = self.next.take_if(|(at, _)| *at <= now) {
            self.now = next;
        }
    }

    /// Plans a change; one that was planned before takes place now.
    fn change(&mut self, from: Time, change: impl FnOnce(&mut State)) {
        self.act(Time::MAX);
        let mut next = self.now;
        change(&mut next);
        self.next = Some((from, next));
    }

    /// Ends what a reset of the controller ends.
    pub fn reset(&mut self) {
        self.act(Time::MAX);
        self.now.locked = false;
    }

    /// The earliest instant from which a sample is to be inverted.
    pub fn next_flip(&self) -> Option<Time> {
        self.flips.iter().copied().min()
    }

    /// Whether the sample at `now` is to be inverted; no later one is then.
    fn take_flip(&mut self, now: Time) -> bool {
        let before = self.flips.len();
        self.flips.retain(|&at| at > now);
        self.flips.len() != before
    }
}

impl Controller {
    /// Joins the controller's pins to its transceiver, or takes them away, from `from` on.
    pub fn connect(&mut self, pins: Pins, from: Time) {
        self.line.change(from, |line| line.pins = pins);
    }

    /// Holds the transmit pin dominant from `from` on until the next [`reset`](Self::reset).
    pub fn lock_transmit_pin(&mut self, from: Time) {
        self.line.change(from, |line| line.locked = true);
    }

    /// Cuts the controller off from the wire, or joins it again.
    pub fn cut(&mut self, cut: bool) {
        self.line.cut = cut;
    }

    /// Inverts the first sample at or after `at`.
    pub fn flip(&mut self, at: Time) {
        self.line.flips.push(at);
    }

    /// What the wire gets from this controller.
    pub(in crate::can) fn output(&self) -> Level {
        if self.line.cut { Level::Recessive } else { self.transmitted() }
    }

    /// Whether edges of the wire reach the controller.
    pub(super) fn hears_wire(&self) -> bool {
        self.line.now.pins.receive && !self.line.cut
    }

    /// What the controller's receive pin gets.
    pub(super) fn heard(&self, wire: Level) -> Level {
        match &self.line {
            line if !line.now.pins.receive => Level::Dominant,
            line if line.cut => self.transmitted(),
            _ => wire,
        }
    }

    /// Level at a sample point. In silent and in loopback mode the controller hears its own
    /// dominant bits inside, as they do not reach the wire or do not count there.
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

    /// What reaches the transceiver.
    fn transmitted(&self) -> Level {
        match self.line.now {
            State { pins: Pins { transmit: false, .. }, .. } => Level::Recessive,
            State { locked: true, .. } => Level::Dominant,
            _ if self.mode.silent => Level::Recessive,
            _ => self.driven,
        }
    }
}
