//! What the node keeps through a power cut, and the log in flash that keeps it.

mod log;
mod record;

pub use log::{Error, Found, Log};

use crate::{BitRateSetting, NodeId};

/// The persistent settings of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// The node-ID; `None`: not configured.
    pub node_id: Option<NodeId>,
    /// The bit rate, or that it is to be detected.
    pub bit_rate: BitRateSetting,
    /// The producer heartbeat time 1017h in milliseconds; 0: no heartbeat.
    pub heartbeat_ms: u16,
}
