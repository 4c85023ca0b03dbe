//! The settings that survive a power cut, and the flash log that keeps them.

mod log;
pub mod parameters;
mod record;

pub use log::{Error, Found, Log};

use crate::{BitRateSetting, NodeId};

/// The persistent settings of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub struct Settings {
    /// The node-ID; `None` if not configured.
    pub node_id: Option<NodeId>,
    /// The bit rate or automatic detection.
    pub bit_rate: BitRateSetting,
}

impl Settings {
    /// Settings with this bit rate, and no node-ID.
    pub const fn new(bit_rate: BitRateSetting) -> Self {
        Self { node_id: None, bit_rate }
    }

    /// Replaces the [`node_id`](Self::node_id).
    #[must_use]
    pub const fn with_node_id(self, node_id: Option<NodeId>) -> Self {
        Self { node_id, ..self }
    }

    /// Replaces the [`bit_rate`](Self::bit_rate).
    #[must_use]
    pub const fn with_bit_rate(self, bit_rate: BitRateSetting) -> Self {
        Self { bit_rate, ..self }
    }
}
