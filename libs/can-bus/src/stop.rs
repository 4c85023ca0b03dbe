//! The reasons that end a run at once.

use std::fmt;

use canopen_node::Frame;

/// A reason to end the sessions and to restore the boards.
#[derive(Clone, Debug)]
pub enum Stop {
    /// There is no such adapter, or it refuses to work.
    NoAdapter(String),
    /// The adapter does not have a bit rate.
    NoBitRate(String),
    /// The adapter has vanished.
    AdapterGone(String),
    /// Ctrl-C.
    Interrupted,
    /// A frame that only a master sends.
    OtherMaster(Frame),
    /// The bench is not fit for the sessions, in words.
    Bench(String),
}

impl std::error::Error for Stop {}

impl Stop {
    /// What was done at a bit rate; `None` if the adapter does not have it.
    pub fn without_rate<T>(outcome: Result<T, Self>) -> Result<Option<T>, Self> {
        match outcome {
            Err(Self::NoBitRate(_)) => Ok(None),
            outcome => outcome.map(Some),
        }
    }
}

impl fmt::Display for Stop {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoAdapter(why) => write!(f, "no adapter: {why}"),
            Self::NoBitRate(why) => write!(f, "the adapter lacks the bit rate: {why}"),
            Self::AdapterGone(why) => write!(f, "the adapter has vanished: {why}"),
            Self::Interrupted => f.write_str("interrupted"),
            Self::OtherMaster(frame) => write!(
                f,
                "two masters: another program or device on this bus sends requests ({frame:?}). Stop it, or take it off the bus"
            ),
            Self::Bench(why) => f.write_str(why),
        }
    }
}
