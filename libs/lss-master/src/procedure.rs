//! What a procedure of the master is made of.

use lss_slave::{BitRate, lss::Request};

use crate::{Error, Service};

/// Several services in an order that may depend on the answers.
///
/// [`Session`](crate::Session) carries out the steps. A single [`Request`] is the simplest procedure.
pub trait Procedure {
    /// The result.
    type Output;

    /// The first step, also of a procedure that has ended before.
    fn begin(&mut self) -> Step<Self::Output>;

    /// The next step after the outcome of the last one.
    fn next(&mut self, outcome: Outcome) -> Step<Self::Output>;
}

/// The outcome of a step: the number in the answer, or 0 if the answer has none. `None`: silence, or a step without
/// an answer.
pub type Outcome = Result<Option<u32>, Error>;

/// What comes next in a procedure.
#[derive(Clone, Debug, PartialEq, Eq)]
#[must_use]
pub enum Step<T> {
    /// A service that must be answered, unless it has no answer. It is repeated before it fails.
    Ask(Service),
    /// A service to which silence is an answer.
    Probe(Service),
    /// A pause in microseconds, below half a turn of [`Instant`](lss_slave::Instant).
    Pause(u32),
    /// The bit rate that the master's own CAN controller takes.
    SetBitRate(BitRate),
    /// From here on each probe waits longer and trusts silence less, since the answers contradict each other.
    SlowDown,
    /// The end.
    Done(Result<T, Error>),
}

impl<T> Step<T> {
    /// A request that must be answered, unless it has no answer.
    pub const fn ask(request: Request) -> Self {
        Self::Ask(Service::Request(request))
    }

    /// A request to which silence is an answer.
    pub const fn probe(request: Request) -> Self {
        Self::Probe(Service::Request(request))
    }

    /// This step of a part of a procedure; if the part has ended, what `end` says.
    pub(crate) fn or_end<U>(self, end: impl FnOnce(Result<T, Error>) -> Step<U>) -> Step<U> {
        match self {
            Self::Ask(service) => Step::Ask(service),
            Self::Probe(service) => Step::Probe(service),
            Self::Pause(micros) => Step::Pause(micros),
            Self::SetBitRate(rate) => Step::SetBitRate(rate),
            Self::SlowDown => Step::SlowDown,
            Self::Done(result) => end(result),
        }
    }
}
