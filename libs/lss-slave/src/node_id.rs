//! The node-ID, 1..=127, and its encoding in LSS messages, where FFh means "not configured".

use core::{error, fmt, num::NonZeroU8};

/// A valid CANopen node-ID: 1..=127. An unconfigured node has `None::<NodeId>` (CiA 305: FFh).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct NodeId(NonZeroU8);

impl NodeId {
    const NOT_CONFIGURED: u8 = 0xFF;

    /// The node-ID `id`, or `None` unless it is 1..=127.
    pub const fn new(id: u8) -> Option<Self> {
        match NonZeroU8::new(id) {
            Some(id) if id.get() <= 127 => Some(Self(id)),
            _ => None,
        }
    }

    /// The number: 1..=127.
    pub const fn get(self) -> u8 {
        self.0.get()
    }

    /// Decodes the node-ID of an LSS message: 1..=127, or FFh for none.
    ///
    /// # Errors
    /// [`InvalidNodeId`] for 0 and 80h..=FEh.
    pub const fn from_lss(byte: u8) -> Result<Option<Self>, InvalidNodeId> {
        match Self::new(byte) {
            None if byte != Self::NOT_CONFIGURED => Err(InvalidNodeId),
            id => Ok(id),
        }
    }

    /// Encodes `id` for an LSS message: 1..=127, or FFh for none.
    pub const fn to_lss(id: Option<Self>) -> u8 {
        match id {
            Some(id) => id.get(),
            None => Self::NOT_CONFIGURED,
        }
    }
}

/// The number.
impl fmt::Display for NodeId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// A byte that is neither a node-ID nor FFh.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub struct InvalidNodeId;

impl fmt::Display for InvalidNodeId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("neither a node-ID (1 to 127) nor FFh")
    }
}

impl error::Error for InvalidNodeId {}
