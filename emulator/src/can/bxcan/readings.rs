//! What the reference manual leaves open and chips may do: one switch for each doubtful reading.

use crate::Time;

/// Readings of the manual other than those that are modelled by default.
///
/// A program that is to run on any chip works under each of them. All are off by default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Readings {
    /// ERRI is set again at each error while the controller is error passive and EPVIE is set, not
    /// only when EPVF rises.
    pub passive_errors_interrupt: bool,
    /// ERRI cannot be cleared while the controller is bus-off and BOFIE is set.
    pub bus_off_holds_interrupt: bool,
    /// TEC shows the lower eight bits of the counter in bus-off, mostly 0, instead of F8h.
    pub bus_off_tec_overflows: bool,
    /// A frame goes into both FIFOs if filters of both let it in, instead of into that of the best
    /// filter.
    pub both_fifos: bool,
    /// The mailbox that goes first on an idle bus is chosen at its SOF, instead of when it asks.
    pub late_choice: bool,
    /// What holds the transmit pin dominant while the controller listens.
    pub transmit_lock: Option<TransmitLock>,
    /// When initialisation mode is acknowledged.
    pub acknowledge: Acknowledge,
}

/// The transmit pin is held dominant, until the next reset by RCC, once frames are seen in a silent
/// mode that was entered first after such a reset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TransmitLock {
    /// It happens each time, or each second, third... time that silent mode is entered so, from 1.
    pub every: u32,
    /// The valid or broken frame at which it happens, from 1.
    pub frame: u32,
}

/// When INAK follows INRQ on a quiet bus.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Acknowledge {
    /// At once.
    #[default]
    Prompt,
    /// After so many bit times.
    Late(u8),
    /// Not until the next reset by RCC, at the first of each `every` requests that are the first
    /// after such a reset.
    Lost {
        /// 1 means that initialisation mode is never acknowledged.
        every: u32,
    },
}

/// The readings in force, and how far what they say has come.
#[derive(Debug, Default)]
pub(super) struct Oddities {
    pub readings: Readings,
    /// Resets by RCC after which initialisation, or silent mode, was entered.
    initializations: u32,
    listenings: u32,
    since_reset: SinceReset,
}

#[derive(Debug, Default)]
struct SinceReset {
    initialized: bool,
    started: bool,
    acknowledge_lost: bool,
    /// Frames that silent mode may still see until the transmit pin is locked.
    frames_left: Option<u32>,
}

impl Oddities {
    pub fn new(readings: Readings) -> Self {
        Self { readings, ..Self::default() }
    }

    /// A reset by RCC.
    pub fn reset(&mut self) {
        self.since_reset = SinceReset::default();
    }

    /// The program asks for initialisation mode, and nothing is under way; returns when INAK is
    /// set.
    pub fn initialize(&mut self, now: Time, bit: Time) -> Time {
        let first = !std::mem::replace(&mut self.since_reset.initialized, true);
        match self.readings.acknowledge {
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

    /// The controller leaves initialisation mode.
    pub fn start(&mut self, silent: bool) {
        let first = !std::mem::replace(&mut self.since_reset.started, true);
        let Some(lock) = self.readings.transmit_lock.filter(|_| first && silent) else { return };
        self.listenings += 1;
        if self.listenings.is_multiple_of(lock.every) {
            self.since_reset.frames_left = Some(lock.frame);
        }
    }

    /// A valid or broken frame was seen in silent mode; returns whether the transmit pin is locked
    /// now.
    pub fn locks(&mut self) -> bool {
        let Some(left) = self.since_reset.frames_left.as_mut() else { return false };
        *left = left.saturating_sub(1);
        *left == 0
    }
}
