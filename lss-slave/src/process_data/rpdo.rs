//! An RPDO: its parameters (CiA 301, 7.5.2.35) and the effect of its frames.

use super::{
    Direction, Mapping, PdoCobId, Rpdo,
    tpdo::{is_transmission_type, stored_transmission_type},
};
use crate::{Application, Frame, NodeId, object_dictionary::Entry, sdo::Abort};

/// Error code of a PDO that is shorter than its mapping, and ignored (CiA 301, table 26).
pub(super) const TOO_SHORT: u16 = 0x8210;
/// Error code of a PDO that is longer than its mapping; its first bytes are used (CiA 301, table 26).
pub(super) const TOO_LONG: u16 = 0x8220;

/// The parameters that are stored before the mapping.
pub(super) const RECEIVE_PARAMETERS: usize = 2;

/// An RPDO.
#[derive(Clone, Copy, Debug)]
pub(super) struct ReceivePdo {
    pub cob_id: PdoCobId,
    pub mapping: Mapping,
    transmission_type: u8,
    /// The error code for the length of the latest frame.
    fault: Option<u16>,
    /// The data that waits for the next SYNC.
    waiting: Option<[u8; 8]>,
}

impl ReceivePdo {
    pub const UNUSED: Self = Self {
        cob_id: PdoCobId::new(false),
        mapping: Mapping::EMPTY,
        transmission_type: 255,
        fault: None,
        waiting: None,
    };

    /// The RPDO of a declaration; panics, at compile time, with what is wrong.
    pub const fn declared(declaration: &Rpdo, objects: &[Entry]) -> Self {
        let Rpdo { mapping, is_valid, transmission_type } = *declaration;
        assert!(
            is_transmission_type(transmission_type),
            "the transmission type of a PDO must be 0 to 240, 254 or 255"
        );
        Self {
            cob_id: PdoCobId::new(is_valid),
            mapping: Mapping::declared(objects, Direction::Receive, mapping),
            transmission_type,
            ..Self::UNUSED
        }
    }

    /// Forgets the frames received until now.
    pub const fn restart(&mut self) {
        self.fault = None;
        self.waiting = None;
    }

    /// The error code for the length of the latest frame.
    pub const fn fault(&self) -> Option<u16> {
        self.fault
    }

    /// Compares the length of a frame with the mapping; returns the error code of a new fault.
    pub fn check_length(&mut self, frame: &Frame) -> Option<u16> {
        let (len, expected) = (frame.data().len(), self.mapping.len());
        let fault = match len {
            _ if self.mapping.is_empty() || len == expected => None,
            _ if len < expected => Some(TOO_SHORT),
            _ => Some(TOO_LONG),
        };
        let is_new = fault != self.fault;
        self.fault = fault;
        fault.filter(|_| is_new)
    }

    /// Takes the data of a frame whose length was checked; returns whether it has taken effect.
    pub fn handle<A: Application>(&mut self, frame: &Frame, application: &mut A) -> bool {
        if self.mapping.is_empty() || self.fault == Some(TOO_SHORT) {
            return false;
        }
        if self.transmission_type <= 240 {
            self.waiting = Some(frame.padded_data());
            return false;
        }
        self.mapping.write(&frame.padded_data(), application);
        true
    }

    /// Lets the data that waits take effect; returns whether there was any.
    pub fn handle_sync<A: Application>(&mut self, application: &mut A) -> bool {
        let Some(data) = self.waiting.take() else {
            return false;
        };
        self.mapping.write(&data, application);
        true
    }

    /// The parameters as they are stored.
    pub fn stored(&self) -> impl Iterator<Item = u32> + Clone {
        let parameters = [self.cob_id.stored(), self.transmission_type.into()];
        parameters.into_iter().chain(self.mapping.stored())
    }

    /// The RPDO with these stored parameters, if they are legal and all its values exist.
    pub fn from_stored(stored: &[[u8; 4]], objects: &[Entry]) -> Option<Self> {
        let (parameters, mapping) = stored.split_first_chunk::<RECEIVE_PARAMETERS>()?;
        let [cob_id, transmission_type] = parameters.map(u32::from_le_bytes);
        Some(Self {
            cob_id: PdoCobId::from_stored(cob_id)?,
            mapping: Mapping::from_stored(mapping, Direction::Receive, objects)?,
            transmission_type: stored_transmission_type(transmission_type)?,
            ..Self::UNUSED
        })
    }

    /// The value of a sub-index of the communication parameter.
    pub fn parameter(&self, sub_index: u8, base: u16, node: Option<NodeId>) -> u32 {
        match sub_index {
            1 => self.cob_id.value(base, node),
            _ => self.transmission_type.into(),
        }
    }

    /// Sets a sub-index of the communication parameter.
    ///
    /// # Errors
    /// [`Abort::InvalidValue`], or [`Abort::DeviceState`] for what a valid PDO does not allow.
    pub fn set_parameter(
        &mut self,
        sub_index: u8,
        value: u32,
        base: u16,
        node: Option<NodeId>,
    ) -> Result<(), Abort> {
        match sub_index {
            1 => self.cob_id.set(value, base, node)?,
            _ if !is_transmission_type(value as u8) => return Err(Abort::InvalidValue),
            _ => self.transmission_type = value as u8,
        }
        self.restart();
        Ok(())
    }
}
