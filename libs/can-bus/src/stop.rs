//! The reasons that end a run at once.

use canopen_node::Frame;
use thiserror::Error;

/// A reason to end the sessions and to restore the boards.
#[derive(Clone, Debug, Error)]
pub enum Stop {
    /// There is no such adapter, or it refuses to work.
    #[error("no adapter: {0}")]
    NoAdapter(String),
    #[error("the adapter has vanished: {0}")]
    AdapterGone(String),
    /// Ctrl-C.
    #[error("interrupted")]
    Interrupted,
    /// A frame that only a master sends.
    #[error(
        "two masters: another program or device on this bus sends requests ({0:?}). Stop it, or take it off the bus"
    )]
    OtherMaster(Frame),
    /// The bench is not fit for the sessions, in words.
    #[error("{0}")]
    Bench(String),
}
