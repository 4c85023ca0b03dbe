//! The parameters of emergency messages (CiA 301, 7.5.2.17 and 7.5.2.18): 1014h and 1015h.

use super::COB_ID;
use crate::{
    NodeId,
    cob_id::CobId,
    object_dictionary::DataType,
    sdo::Abort,
    settings::parameters::{HEADER, Packer, Parameter},
};

const COB_ID_EMERGENCY: u16 = 0x1014;
const INHIBIT_TIME: u16 = 0x1015;

/// The parameters of emergency messages.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Configuration {
    cob_id: CobId,
    /// 1015h: the time between two messages, in multiples of 100 us.
    pub inhibit_time: u16,
}

impl Configuration {
    /// The parameters of a new device.
    pub const DEFAULT: Self = Self { cob_id: CobId::new(true), inhibit_time: 0 };
    /// The greatest number of bytes that the stored parameters take.
    pub const STORED_LEN: usize = HEADER + 4 + HEADER + 2;

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

    /// Packs the parameters: one that is not stored has its default.
    pub fn save(&self, to: &mut Packer<'_>) {
        if self.cob_id != Self::DEFAULT.cob_id {
            let (data_type, value) =
                (DataType::Unsigned32 as u8, &self.cob_id.stored().to_le_bytes());
            to.put(&Parameter { index: COB_ID_EMERGENCY, sub_index: 0, data_type, value });
        }
        if self.inhibit_time != 0 {
            let (data_type, value) = (DataType::Unsigned16 as u8, &self.inhibit_time.to_le_bytes());
            to.put(&Parameter { index: INHIBIT_TIME, sub_index: 0, data_type, value });
        }
    }

    /// Takes a stored parameter, if it is one of these and is legal.
    pub fn take(&mut self, parameter: &Parameter<'_>) -> Option<()> {
        const U16: u8 = DataType::Unsigned16 as u8;
        const U32: u8 = DataType::Unsigned32 as u8;
        match (parameter.index, parameter.sub_index, parameter.data_type, parameter.value) {
            (COB_ID_EMERGENCY, 0, U32, &[b0, b1, b2, b3]) => {
                self.cob_id = CobId::from_stored(u32::from_le_bytes([b0, b1, b2, b3]))?;
            }
            (INHIBIT_TIME, 0, U16, &[b0, b1]) => {
                self.inhibit_time = u16::from_le_bytes([b0, b1]);
            }
            _ => return None,
        }
        Some(())
    }
}
