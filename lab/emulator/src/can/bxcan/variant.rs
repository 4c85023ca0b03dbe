//! The variants of the controller that the reference manual leaves open: one switch for each passage.

use crate::Time;

/// Differences of a controller from the modelled default that the manual does not exclude.
///
/// A program that must run on any chip works under each of them. All are off by default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CanVariant {
    /// ERRI is set again at each error while the controller is error passive and EPVIE is set, not only when EPVF
    /// rises.
    pub passive_errors_interrupt: bool,
    /// ERRI cannot be cleared while the controller is bus-off and BOFIE is set.
    pub bus_off_holds_interrupt: bool,
    /// In bus-off TEC shows the lower eight bits of the counter, mostly 0, instead of F8h.
    pub bus_off_tec_overflows: bool,
    /// A frame goes into both FIFOs if filters of both accept it, instead of only into that of the best filter.
    pub both_fifos: bool,
    /// The first mailbox on an idle bus is chosen at its SOF, instead of at its request.
    pub late_choice: bool,
    /// Condition that locks the transmit pin dominant while the controller listens.
    pub transmit_lock: Option<TransmitLock>,
    pub acknowledge: Acknowledge,
    /// A receive FIFO shows a released frame, and RFOM, for two cycles of APB1, instead of the next frame at once.
    pub late_release: bool,
}

/// The transmit pin becomes dominant, until the next reset by RCC, once frames are received in a silent mode that was
/// entered first after such a reset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TransmitLock {
    /// It happens at every n-th such entry into silent mode, from 1.
    pub every: u32,
    /// The number of the valid or broken frame at which it happens, from 1.
    pub frame: u32,
}

/// The time from INRQ to INAK on a quiet bus.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Acknowledge {
    #[default]
    Prompt,
    /// After this number of bit times.
    Late(u8),
    /// Not until the next reset by RCC, at the first of each `every` requests that are the first after such a reset.
    Lost {
        /// 1 means that initialisation mode is never acknowledged.
        every: u32,
    },
}

/// The variant in force, and its state.
#[derive(Debug, Default)]
pub(super) struct Behaviour {
    pub variant: CanVariant,
    /// Resets by RCC that were followed by initialisation, or by silent mode.
    initializations: u32,
    listenings: u32,
    since_reset: SinceReset,
}

#[derive(Debug, Default)]
struct SinceReset {
    initialized: bool,
    started: bool,
    acknowledge_lost: bool,
    /// Frames that silent mode may still receive until the transmit pin is locked.
    frames_left: Option<u32>,
}

impl Behaviour {
    pub fn new(variant: CanVariant) -> Self {
        Self { variant, ..Self::default() }
    }

    /// Handles a reset by RCC.
    pub fn reset(&mut self) {
        self.since_reset = SinceReset::default();
    }

    /// Handles a request for initialisation mode while nothing is under way; returns the time at which INAK is set.
    pub fn initialize(&mut self, now: Time, bit: Time) -> Time {
        let first = !std::mem::replace(&mut self.since_reset.initialized, true);
        match self.variant.acknowledge {
            Acknowledge::Prompt => now,
            Acknowledge::Late(bits) => now + bit * u64::from(bits),
            Acknowledge::Lost { every } => {
                if first {
                    self.since_reset.acknowledge_lost = self.initializations.is_multiple_of(every);
                    self.initializations += 1;
                }
                if self.since_reset.acknowledge_lost { Time::MAX } else { now }
            }
        }
    }

    /// Handles the end of initialisation mode.
    pub fn start(&mut self, silent: bool) {
        let first = !std::mem::replace(&mut self.since_reset.started, true);
        let Some(lock) = self.variant.transmit_lock.filter(|_| first && silent) else { return };
        self.listenings += 1;
        if self.listenings.is_multiple_of(lock.every) {
            self.since_reset.frames_left = Some(lock.frame);
        }
    }

    /// Handles a valid or broken frame in silent mode; returns whether the transmit pin is locked now.
    pub fn locks(&mut self) -> bool {
        let Some(left) = self.since_reset.frames_left.as_mut() else { return false };
        *left = left.saturating_sub(1);
        *left == 0
    }
}
