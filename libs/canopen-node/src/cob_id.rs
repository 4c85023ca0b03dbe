//! COB-IDs that a master can move: valid or not, and at their default or elsewhere (CiA 301, 7.5.2.17 and 7.5.2.35).

use crate::{NodeId, sdo::Abort};

const NOT_VALID: u32 = 1 << 31;
/// In a stored COB-ID, in place of the CAN-ID: it follows the node-ID.
const FOLLOWS_NODE_ID: u32 = 1 << 11;

/// The CAN-ID of a service that has none yet. It is restricted, so no service has it.
const NONE: u16 = 0;

/// Whether CiA 301 reserves a CAN-ID (7.3.5, restricted CAN-IDs).
pub(crate) const fn is_restricted(id: u16) -> bool {
    matches!(
        id,
        0x000..=0x07F | 0x101..=0x180 | 0x581..=0x5FF | 0x601..=0x67F | 0x6E0..=0x6FF | 0x701..
    )
}

/// The COB-ID of a PDO or of emergency messages. Its `base` is the COB-ID in the predefined connection set, to which the
/// node-ID is added; `None` beyond that set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct CobId {
    pub is_valid: bool,
    /// `None`: the COB-ID of the predefined connection set, which follows the node-ID; none beyond that set.
    moved_to: Option<u16>,
}

impl CobId {
    pub const fn new(is_valid: bool) -> Self {
        Self { is_valid, moved_to: None }
    }

    fn id(self, base: Option<u16>, node: Option<NodeId>) -> u16 {
        let of_node = node.map_or(0, |node| u16::from(node.get()));
        self.moved_to.unwrap_or(base.map_or(NONE, |base| base.wrapping_add(of_node)))
    }

    /// The COB-ID in use, if it is valid.
    pub fn active(self, base: Option<u16>, node: Option<NodeId>) -> Option<u16> {
        let id = self.id(base, node);
        (self.is_valid && id != NONE).then_some(id)
    }

    /// The value of its object.
    pub fn value(self, base: Option<u16>, node: Option<NodeId>) -> u32 {
        u32::from(self.id(base, node)) | if self.is_valid { 0 } else { NOT_VALID }
    }

    /// Sets the value of its object. A service that is put at its default COB-ID follows the node-ID again.
    ///
    /// # Errors
    /// [`Abort::InvalidValue`] for a 29-bit identifier, a reserved bit, or a restricted CAN-ID of a valid service;
    /// [`Abort::DeviceState`] for another COB-ID of a service that is and stays valid.
    pub fn set(
        &mut self,
        value: u32,
        base: Option<u16>,
        node: Option<NodeId>,
    ) -> Result<(), Abort> {
        let id = (value & 0x7FF) as u16;
        let is_valid = value & NOT_VALID == 0;
        if value & !(NOT_VALID | 0x7FF) != 0 || is_valid && is_restricted(id) {
            return Err(Abort::InvalidValue);
        }
        if is_valid && self.is_valid && id != self.id(base, node) {
            return Err(Abort::DeviceState);
        }
        let is_default = id == Self::new(is_valid).id(base, node);
        *self = Self { is_valid, moved_to: (!is_default).then_some(id) };
        Ok(())
    }

    /// The COB-ID as it is stored, which does not depend on the node-ID.
    pub fn stored(self) -> u32 {
        let id = self.moved_to.map_or(FOLLOWS_NODE_ID, u32::from);
        id | if self.is_valid { 0 } else { NOT_VALID }
    }

    /// The COB-ID that was stored, if it is legal.
    pub fn from_stored(stored: u32) -> Option<Self> {
        let is_valid = stored & NOT_VALID == 0;
        let moved_to = match stored & !NOT_VALID {
            FOLLOWS_NODE_ID => None,
            id @ 0..=0x7FF => Some(id as u16),
            _ => return None,
        };
        let is_legal = !(is_valid && moved_to.is_some_and(is_restricted));
        is_legal.then_some(Self { is_valid, moved_to })
    }
}
