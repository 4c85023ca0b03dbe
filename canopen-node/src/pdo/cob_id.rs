//! The COB-ID of a PDO (CiA 301, 7.5.2.35): valid or not, and at its default or where a master has put it.

use crate::{NodeId, cob_id::is_restricted, sdo::Abort};

const NOT_VALID: u32 = 1 << 31;
const NO_REMOTE_FRAME: u32 = 1 << 30;
/// In a stored COB-ID, in place of the CAN-ID: it follows the node-ID.
const FOLLOWS_NODE_ID: u32 = 1 << 11;

/// The CAN-ID of a PDO that has none yet. It is restricted, so no PDO has it.
const NONE: u16 = 0;

/// The COB-ID of a PDO.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct PdoCobId {
    pub is_valid: bool,
    /// `None`: the COB-ID of the predefined connection set, which follows the node-ID; none beyond that set.
    moved_to: Option<u16>,
}

impl PdoCobId {
    pub const fn new(is_valid: bool) -> Self {
        Self { is_valid, moved_to: None }
    }

    #[inline(never)] // It has several callers.
    fn id(self, base: Option<u16>, node: Option<NodeId>) -> u16 {
        let of_node = node.map_or(0, |node| u16::from(node.get()));
        self.moved_to.unwrap_or(base.map_or(NONE, |base| base.wrapping_add(of_node)))
    }

    /// The COB-ID in use, if the PDO is valid.
    pub fn active(self, base: Option<u16>, node: Option<NodeId>) -> Option<u16> {
        let id = self.id(base, node);
        (self.is_valid && id != NONE).then_some(id)
    }

    /// Sub-index 1 of the communication parameter of an RPDO.
    pub fn value(self, base: Option<u16>, node: Option<NodeId>) -> u32 {
        u32::from(self.id(base, node)) | if self.is_valid { 0 } else { NOT_VALID }
    }

    /// Sub-index 1 of the communication parameter of a TPDO, which answers no remote frame.
    pub fn transmit_value(self, base: Option<u16>, node: Option<NodeId>) -> u32 {
        self.value(base, node) | NO_REMOTE_FRAME
    }

    /// Sets sub-index 1. A PDO that is put at its default COB-ID follows the node-ID again.
    ///
    /// # Errors
    /// [`Abort::InvalidValue`] for a 29-bit identifier, or a restricted CAN-ID of a valid PDO; [`Abort::DeviceState`]
    /// for another COB-ID of a PDO that is and stays valid.
    pub fn set(
        &mut self,
        value: u32,
        base: Option<u16>,
        node: Option<NodeId>,
    ) -> Result<(), Abort> {
        let id = (value & 0x7FF) as u16;
        let is_valid = value & NOT_VALID == 0;
        if value & !(NOT_VALID | NO_REMOTE_FRAME | 0x7FF) != 0 || is_valid && is_restricted(id) {
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
