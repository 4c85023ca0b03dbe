//! The controller, and how it runs.

use super::{Controller, Mode, sampler::Sampler};
use crate::{BitRate, Instant, Numbers, Receives};

/// The controller with its mode.
#[derive(Debug)]
pub struct Bus<C> {
    pub can: C,
    pub mode: Mode,
    pub bit_rate: BitRate,
    /// Whether it runs in this mode and at this rate.
    pub is_started: bool,
    /// Whether the bit rate is not proven: errors and samples of the bus matter.
    pub is_searching: bool,
    /// While listening: whether anything was heard since the last look at the controller's state.
    pub has_heard: bool,
    pub sampler: Sampler,
}

impl<C: Controller> Bus<C> {
    /// A controller that has not been started yet, and need not be.
    pub const fn new(can: C, bit_rate: BitRate) -> Self {
        Self {
            can,
            mode: Mode::TakePart,
            bit_rate,
            is_started: true,
            is_searching: true,
            has_heard: false,
            sampler: Sampler::new(),
        }
    }

    /// Whether the controller only listens.
    pub fn is_listening(&self) -> bool {
        self.mode == Mode::Listen
    }

    /// Starts the controller in its mode and at its rate.
    pub fn restart<N: Numbers>(&mut self, receives: &Receives<N>, now: Instant) {
        self.is_searching = receives.all;
        self.sample(now);
        self.is_started = self.can.start(self.mode, self.bit_rate, receives);
    }

    /// Starts sampling the bus, unless the bit rate is proven.
    #[inline(never)] // Inlined, it takes 48 to 60 bytes more.
    pub fn sample(&mut self, now: Instant) {
        if self.is_searching && self.can.sample().is_some() {
            self.sampler.begin(now);
        }
    }
}
