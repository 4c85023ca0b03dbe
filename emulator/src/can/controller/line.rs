//! The line between a controller and the wire, and what is wrong with it.

use super::Controller;
use crate::{Time, can::Level};

/// How a controller is joined to the wire; no reset of the controller changes it.
#[derive(Debug, Default)]
pub(super) struct Line {
    /// The station is cut off: its transceiver returns what it drives itself, and nothing else.
    cut: bool,
    /// The first sample at or after each of these instants is inverted.
    flips: Vec<Time>,
}

impl Line {
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

    /// What the controller's receive pin gets.
    pub(super) fn heard(&self, wire: Level) -> Level {
        if self.line.cut { self.transmitted() } else { wire }
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

    /// What leaves on the transmit pin.
    fn transmitted(&self) -> Level {
        if self.mode.silent { Level::Recessive } else { self.driven }
    }
}
