//! The RUN and ERR indicators of CiA 303-3, driven by the state of the node and of its controller.

use crate::nmt;

/// The period of [`Indicators::step`]: 50 ms, the pace of flickering.
pub const STEP_MS: u32 = 50;

/// The controller's fault confinement state (ISO 11898-1).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum BusState {
    /// Both error counters are below the warning level of 96.
    Good,
    /// At least one error counter has reached the warning level.
    Warning,
    /// The controller takes no part in the bus because of too many errors.
    BusOff,
}

/// The indicators that are on. A single two-colour LED can show both.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Lit {
    /// The green RUN indicator.
    pub run: bool,
    /// The red ERR indicator.
    pub error: bool,
}

/// The indicators' state: a count of steps.
#[derive(Clone, Debug, Default)]
pub struct Indicators {
    step: u8,
}

/// A pattern of CiA 303-3, in steps of 50 ms.
#[derive(Clone, Copy)]
enum Pattern {
    Off,
    On,
    /// 50 ms on, 50 ms off.
    Flickering,
    /// 200 ms on, 200 ms off.
    Blinking,
    /// 200 ms on, 1000 ms off.
    SingleFlash,
}

/// A common multiple of the periods of all patterns.
const STEPS: u8 = 48;

impl Pattern {
    const fn is_on(self, step: u8) -> bool {
        match self {
            Self::Off => false,
            Self::On => true,
            Self::Flickering => step.is_multiple_of(2),
            Self::Blinking => step % 8 < 4,
            Self::SingleFlash => step % 24 < 4,
        }
    }
}

impl Indicators {
    /// Returns the indicators to light for the next 50 ms.
    ///
    /// While LSS is active (`is_lss_active`: LSS configuration state, or no node-ID) both flicker alternately.
    pub fn step(&mut self, nmt: nmt::State, is_lss_active: bool, bus: BusState) -> Lit {
        let step = self.step;
        self.step = step.wrapping_add(1) % STEPS;
        if is_lss_active {
            let run = Pattern::Flickering.is_on(step);
            return Lit { run, error: bus == BusState::BusOff || !run };
        }
        let run = match nmt {
            nmt::State::Initialisation => Pattern::Off,
            nmt::State::PreOperational => Pattern::Blinking,
            nmt::State::Operational => Pattern::On,
            nmt::State::Stopped => Pattern::SingleFlash,
        };
        let error = match bus {
            BusState::Good => Pattern::Off,
            BusState::Warning => Pattern::SingleFlash,
            BusState::BusOff => Pattern::On,
        };
        Lit { run: run.is_on(step), error: error.is_on(step) }
    }
}
