//! The PDOs among the parameters that 1010h stores: each as a whole, its parameters and its mapping.
//!
//! A PDO is one value, at sub-index 0 of its communication parameter: numbers of four bytes, little endian.
//!
//! | PDO | numbers |
//! |---|---|
//! | RPDO | COB-ID, transmission type, the mapped objects |
//! | TPDO | COB-ID, transmission type, inhibit time, event timer, SYNC start value, the mapped objects |
//!
//! Bit 31 of the COB-ID is set in a PDO that is not valid. Bit 30 is set in one whose bit 30 a master has
//! changed. Bits 10 to 0 are the CAN-ID, unless bit 11 is set in place of
//! them: then the PDO has its default COB-ID, which follows the node-ID. The mapped objects are as in the mapping
//! parameter, as many as the PDO carries. If one of them does not exist any more, has another length or cannot be
//! mapped, the PDO is as the application declares it.

use super::{
    Configuration,
    mapping::{Direction, MAX_MAPPED},
    parameters::Pdo,
    tables::{RPDO_MAPPING, RPDO_PARAMETER, TPDO_MAPPING, TPDO_PARAMETER},
};
use crate::{
    numbers::Numbers,
    object_dictionary::{Entry, Object},
    settings::parameters::{HEADER, Packer, Parameter},
};

/// The data type of a stored PDO: PDO_COMMUNICATION_PARAMETER (CiA 301, 7.4.8.1), here followed by the mapping.
const PDO: u8 = 0x20;

impl<N: Numbers> Configuration<N> {
    /// The greatest number of bytes that the stored parameters take.
    pub const STORED_LEN: usize = {
        N::RPDOS * (HEADER + 4 * (Pdo::stored_parameters(Direction::Receive) + MAX_MAPPED))
            + N::TPDOS * (HEADER + 4 * (Pdo::stored_parameters(Direction::Transmit) + MAX_MAPPED))
    };

    /// Removes what is not stored: the entries of mappings that the PDO does not carry.
    pub fn remove_unused(&mut self) {
        let pdos = self.tpdos.as_mut().iter_mut().chain(self.rpdos.as_mut());
        pdos.for_each(|pdo| pdo.mapping.remove_unused());
    }

    /// Packs the PDOs, but for the event timers of RPDOs.
    pub fn save(&self, to: &mut Packer<'_>) {
        for (index, rpdo) in (RPDO_PARAMETER..).zip(self.rpdos.as_ref()) {
            put_pdo(to, index, rpdo, Direction::Receive);
        }
        for (index, tpdo) in (TPDO_PARAMETER..).zip(self.tpdos.as_ref()) {
            put_pdo(to, index, tpdo, Direction::Transmit);
        }
    }

    /// Takes a stored PDO, if it is legal. One with a value that cannot be mapped stays as it is.
    pub fn take(&mut self, parameter: &Parameter<'_>, objects: &'static [Entry]) -> Option<()> {
        let Parameter { index, sub_index, data_type, value } = *parameter;
        let (direction, first) = match (index, sub_index, data_type) {
            (RPDO_PARAMETER..RPDO_MAPPING, 0, PDO) => (Direction::Receive, RPDO_PARAMETER),
            (TPDO_PARAMETER..TPDO_MAPPING, 0, PDO) => (Direction::Transmit, TPDO_PARAMETER),
            _ => return None,
        };
        let pdo = self.pdo_mut(direction, usize::from(index.wrapping_sub(first)))?;
        *pdo = Pdo::from_stored(words(value)?, direction, objects)?;
        Some(())
    }

    /// Takes the stored value of a row, if it is legal.
    pub fn take_row(&mut self, object: Object, value: u32) -> Option<()> {
        match object {
            Object::RpdoParameter(part) => {
                self.pdo_mut(Direction::Receive, part.at())?.event_timer_ms = value as u16;
                Some(())
            }
            _ => self.sync.write(object, value).ok(),
        }
    }
}

fn put_pdo(to: &mut Packer<'_>, index: u16, pdo: &Pdo, direction: Direction) {
    let parameters = Pdo::stored_parameters(direction);
    let len = 4 * parameters.saturating_add(pdo.mapping.number());
    let (place, _) = to.reserve(index, 0, PDO, len).as_chunks_mut();
    let (to_parameters, to_mapping) = place.split_at_mut(parameters.min(place.len()));
    for (to, number) in to_parameters.iter_mut().zip(pdo.stored()) {
        *to = number.to_le_bytes();
    }
    for (to, code) in to_mapping.iter_mut().zip(pdo.mapping.stored()) {
        *to = code.to_le_bytes();
    }
}

fn words(value: &[u8]) -> Option<&[[u8; 4]]> {
    match value.as_chunks() {
        (words, []) => Some(words),
        _ => None,
    }
}
