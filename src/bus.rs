//! The node's place on the bus: is its bit rate proven, on trial, or to be found by listening?
//!
//! A bit rate is *on trial* from power-on, from a switch and from a bus-off until a frame has been received, or one of our
//! own acknowledged: then it is *proven*, and nothing but the next of these three events questions it. If it fails on
//! trial, which means that the controller became error passive by what it received, or bus-off, or that error was seen after
//! error, without one good frame, the node falls silent and *listens*: it sends no dominant bit until a valid frame has shown
//! a rate that works.
//!
//! Listening goes from the fastest rate down. A frame at a slower rate holds its bits longer than a faster listener can
//! take for stuffed data, so that at every rate above the true one each frame ends in an error, which leads one step
//! down; after 1.5 s without anything heard, which is longer than the heartbeats of a quiet network are apart, the search
//! starts again at the top, where nothing is missed.

use crate::{BitRate, BitRates, Instant};

/// What the controller has seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BusEvent {
    /// A valid frame was received, whether the node wants it or not.
    Received,
    /// A frame of the node was sent and acknowledged.
    Acknowledged,
    /// What was last seen on the bus is an error, but no missing acknowledge: nobody may be there. To be told of each while
    /// listening; else it is enough to look a few times a second.
    Error,
    /// The controller is error passive through what it received (REC over 127). Missing acknowledges, which make an error
    /// passive transmitter of a node that is alone, do not count.
    ReceivesErrorsOnly,
    /// The controller is bus-off.
    BusOff,
}

/// So many times an [`Error`](BusEvent::Error) is seen on trial until the rate fails. Error counters alone do not tell: two
/// nodes that both repeat a frame for ever may fall into step, and a transmitter's errors in the arbitration do not count.
pub(crate) const ERRORS_ON_TRIAL: u8 = 8;

/// How long nothing is heard until listening starts again at the fastest rate, in microseconds.
const QUIET_MICROS: u32 = 1_500_000;
/// So many times in a row, and a node with a fixed rate tries that rate again: 30 s.
const QUIET_TURNS: u8 = 20;

/// Where the node stands.
#[derive(Clone, Debug)]
pub(crate) enum Bus {
    OnTrial {
        errors: u8,
    },
    Proven,
    Listening(Listening),
    /// Listening has shown a rate at which the node can take part in the bus.
    Found(BitRate),
}

impl Bus {
    pub const ON_TRIAL: Self = Self::OnTrial { errors: 0 };
}

/// A search for the bit rate.
#[derive(Clone, Debug)]
pub(crate) struct Listening {
    rate: BitRate,
    /// The controller has not been told of the rate.
    is_new: bool,
    quiet_until: Instant,
    quiet_turns: u8,
    /// The rate to try again on a bus that stays silent; `None`: there is none, listen for ever.
    fallback: Option<BitRate>,
}

/// What listening asks of the node.
pub(crate) enum Step {
    Listen(BitRate),
    /// Nothing was heard for long: take part in the bus at this rate again, on trial.
    TryAgain(BitRate),
}

impl Listening {
    pub const fn begin(first: BitRate, fallback: Option<BitRate>) -> Self {
        let quiet_until = Instant::from_micros(0);
        Self { rate: first, is_new: true, quiet_until, quiet_turns: 0, fallback }
    }

    pub const fn rate(&self) -> BitRate {
        self.rate
    }

    /// When [`step`](Self::step) is due.
    pub const fn deadline(&self) -> Instant {
        self.quiet_until
    }

    /// Something is on the bus, but not at this rate: the next slower one, after the slowest the fastest.
    pub fn handle_error(&mut self, rates: BitRates) {
        let mut slower = BitRate::ALL.into_iter().filter(|rate| rates.contains(*rate));
        let mut slower_again = slower.clone();
        self.rate = slower
            .find(|rate| rate.kbit_per_s() < self.rate.kbit_per_s())
            .or_else(|| slower_again.next())
            .unwrap_or(self.rate);
        self.is_new = true;
        self.quiet_turns = 0;
    }

    pub fn step(&mut self, rates: BitRates, now: Instant) -> Option<Step> {
        if !self.is_new && !self.quiet_until.has_come(now) {
            return None;
        }
        self.quiet_until = now.plus_micros(QUIET_MICROS);
        if self.is_new {
            self.is_new = false;
            return Some(Step::Listen(self.rate));
        }
        self.quiet_turns = self.quiet_turns.saturating_add(1);
        if self.quiet_turns >= QUIET_TURNS
            && let Some(rate) = self.fallback
        {
            return Some(Step::TryAgain(rate));
        }
        let fastest = rates.fastest();
        (self.rate != fastest).then(|| {
            self.rate = fastest;
            Step::Listen(fastest)
        })
    }
}
