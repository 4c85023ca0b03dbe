//! Object 2FF0h, for masters without LSS: the pending node-ID and bit rate (CiA 305) by SDO, in a product that turns it on.

use crate::{
    BitRate, BitRateSetting, NodeId, Settings,
    lss::StateMachine,
    object_dictionary::{
        Access::{Const, ReadWrite},
        DataType::{Unsigned8, Unsigned16},
        DefaultValue, Description, Entry, Object, row,
    },
    sdo::Abort,
};

pub(super) const INDEX: u16 = 0x2FF0;
/// The bit rate in the object that stands for automatic detection.
const AUTOMATIC: u16 = 0;

pub(super) const ROWS: &[Entry] = &[
    row(INDEX, 0, Unsigned8, Const, Object::HighestSubIndex(2)),
    row(INDEX, 1, Unsigned8, ReadWrite, Object::PendingNodeId),
    row(INDEX, 2, Unsigned16, ReadWrite, Object::PendingBitRate),
];

/// The rows with their descriptions.
pub(super) fn entries() -> impl Iterator<Item = (Entry, Description)> {
    let describe = |entry: &Entry| {
        let (object, name, limits) = match entry.sub_index {
            0 => (Some("Node-ID and bit rate".into()), "Highest sub-index supported", None),
            1 => (None, "Pending node-ID", Some((1_u8.into(), u8::MAX.into()))),
            _ => (None, "Pending bit rate in kbit/s", None),
        };
        Description { object, name: name.into(), default: DefaultValue::Varies, limits }
    };
    ROWS.iter().map(move |entry| (*entry, describe(entry)))
}

/// The pending node-ID as LSS encodes it: FFh for none.
pub(super) const fn node_id(lss: &StateMachine) -> u8 {
    NodeId::to_lss(lss.pending_node_id())
}

/// The pending bit rate in kbit/s; 0 is automatic detection.
pub(super) const fn bit_rate(lss: &StateMachine) -> u16 {
    match lss.pending_bit_rate() {
        BitRateSetting::Fixed(rate) => rate.kbit_per_s(),
        BitRateSetting::Automatic => AUTOMATIC,
    }
}

/// What clients have written. 1010h stores it unless LSS has replaced it: what LSS has configured is stored by LSS alone.
#[derive(Clone, Copy, Debug)]
pub(super) struct Written {
    node_id: Option<Option<NodeId>>,
    bit_rate: Option<BitRateSetting>,
}

impl Written {
    pub const NOTHING: Self = Self { node_id: None, bit_rate: None };

    /// Sets the pending node-ID.
    ///
    /// # Errors
    /// [`Abort::InvalidValue`] where LSS refuses it.
    pub fn set_node_id(&mut self, lss: &mut StateMachine, value: u8) -> Result<(), Abort> {
        let node_id = NodeId::from_lss(value).map_err(|_| Abort::InvalidValue)?;
        lss.configure_node_id(node_id);
        self.node_id = Some(node_id);
        Ok(())
    }

    /// Sets the pending bit rate, in kbit/s.
    ///
    /// # Errors
    /// [`Abort::InvalidValue`] where LSS refuses it.
    pub fn set_bit_rate(&mut self, lss: &mut StateMachine, kbit_per_s: u16) -> Result<(), Abort> {
        let rate = match kbit_per_s {
            AUTOMATIC => Some(BitRateSetting::Automatic),
            _ => BitRate::from_kbit_per_s(kbit_per_s).map(BitRateSetting::Fixed),
        };
        let rate = rate.filter(|rate| lss.configure_bit_rate(*rate)).ok_or(Abort::InvalidValue)?;
        self.bit_rate = Some(rate);
        Ok(())
    }

    /// The settings to store.
    pub fn apply(&self, settings: Settings, lss: &StateMachine) -> Settings {
        let mut settings = settings;
        if self.node_id == Some(lss.pending_node_id()) {
            settings = settings.with_node_id(lss.pending_node_id());
        }
        if self.bit_rate == Some(lss.pending_bit_rate()) {
            settings = settings.with_bit_rate(lss.pending_bit_rate());
        }
        settings
    }
}
