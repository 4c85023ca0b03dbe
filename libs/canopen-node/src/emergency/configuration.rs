//! The parameters of emergency messages (CiA 301, 7.5.2.17 and 7.5.2.18): 1014h and 1015h.

use super::COB_ID;
use crate::{NodeId, cob_id::CobId, sdo::Abort};

/// The parameters of emergency messages.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Configuration {
    /// 1014h.
    pub cob_id: CobId,
    /// 1015h: the time between two messages, in multiples of 100 us.
    pub inhibit_time: u16,
}

impl Configuration {
    /// The parameters of a new device.
    pub const DEFAULT: Self = Self { cob_id: CobId::new(true), inhibit_time: 0 };

    /// The COB-ID of messages, unless a master has switched them off.
    pub fn cob_id(&self, node: NodeId) -> Option<u16> {
        self.cob_id.active(Some(COB_ID), Some(node))
    }

    /// The value of 1014h.
    pub fn cob_id_value(&self, node: Option<NodeId>) -> u32 {
        self.cob_id.value(Some(COB_ID), node)
    }

    /// Sets 1014h.
    ///
    /// # Errors
    /// Those of [`CobId::set`].
    pub fn set_cob_id(&mut self, value: u32, node: Option<NodeId>) -> Result<(), Abort> {
        self.cob_id.set(value, Some(COB_ID), node)
    }
}
