//! The parameters of a PDO: COB-ID, times (CiA 301, 7.5.2.35 and 7.5.2.37) and mapping.

use super::{Direction, Mapping, PREDEFINED, Rpdo, Tpdo};
use crate::{
    NodeId, cob_id::CobId, declaration_error::DeclarationError, object_dictionary::Entry,
    sdo::Abort,
};

/// In the COB-ID of a TPDO: no remote frame is allowed on it. No PDO answers one, but the bit reads as it was written.
const NO_REMOTE_FRAME: u32 = 1 << 30;

/// The parameters of a PDO. Inhibit time and SYNC start value belong to TPDOs.
#[derive(Clone, Copy, Debug)]
pub struct Pdo {
    pub(super) cob_id: CobId,
    /// A master has changed bit 30 of the COB-ID, which is set in a new TPDO and clear in a new RPDO.
    is_bit_30_changed: bool,
    pub(super) mapping: Mapping,
    pub(super) transmission_type: u8,
    /// In multiples of 100 us.
    pub(super) inhibit_time: u16,
    pub(super) event_timer_ms: u16,
    pub(super) sync_start_value: u8,
}

/// Whether CiA 301 defines a transmission type that does not depend on remote frames.
const fn is_transmission_type(transmission_type: u8) -> bool {
    matches!(transmission_type, 0..=240 | 254 | 255)
}

/// Checks what TPDOs and RPDOs have in common.
const fn check(direction: Direction, number: usize, transmission_type: u8, is_valid: bool) {
    let error = DeclarationError::of_pdo(direction.pdo(), number);
    if !is_transmission_type(transmission_type) {
        error.text("the transmission type must be 0 to 240, 254 or 255").raise();
    }
    if is_valid && number > PREDEFINED {
        error
            .text("it must be `invalid()`: only the first 4 have a COB-ID in a new device")
            .raise();
    }
}

impl Pdo {
    pub(super) const UNUSED: Self = Self {
        cob_id: CobId::new(false),
        is_bit_30_changed: false,
        mapping: Mapping::EMPTY,
        transmission_type: 255,
        inhibit_time: 0,
        event_timer_ms: 0,
        sync_start_value: 0,
    };

    pub(super) const fn event_timer_micros(&self) -> u32 {
        self.event_timer_ms as u32 * 1000
    }

    /// The number of parameters that are stored before the mapping.
    pub(super) const fn stored_parameters(direction: Direction) -> usize {
        match direction {
            Direction::Transmit => 5,
            Direction::Receive => 2,
        }
    }

    /// The TPDO with this number, from 1, as it is declared; panics, at compile time, with what is wrong.
    pub(super) const fn declared_tpdo(
        number: usize,
        declaration: &Tpdo,
        objects: &'static [Entry],
    ) -> Self {
        check(Direction::Transmit, number, declaration.transmission_type, declaration.is_valid);
        if declaration.sync_start_value > 240 {
            DeclarationError::of_pdo(Direction::Transmit.pdo(), number)
                .text("the SYNC start value must be 0 to 240")
                .raise();
        }
        Self {
            cob_id: CobId::new(declaration.is_valid),
            mapping: Mapping::declared(objects, Direction::Transmit, number, declaration.mapping),
            transmission_type: declaration.transmission_type,
            inhibit_time: declaration.inhibit_time,
            event_timer_ms: declaration.event_timer_ms,
            sync_start_value: declaration.sync_start_value,
            ..Self::UNUSED
        }
    }

    /// The RPDO with this number, from 1, as it is declared; panics, at compile time, with what is wrong.
    pub(super) const fn declared_rpdo(
        number: usize,
        declaration: &Rpdo,
        objects: &'static [Entry],
    ) -> Self {
        check(Direction::Receive, number, declaration.transmission_type, declaration.is_valid);
        Self {
            cob_id: CobId::new(declaration.is_valid),
            mapping: Mapping::declared(objects, Direction::Receive, number, declaration.mapping),
            transmission_type: declaration.transmission_type,
            event_timer_ms: declaration.event_timer_ms,
            ..Self::UNUSED
        }
    }

    /// The parameters as they are stored before the mapping.
    pub(super) fn stored(&self) -> [u32; 5] {
        [
            self.cob_id.stored() | if self.is_bit_30_changed { NO_REMOTE_FRAME } else { 0 },
            self.transmission_type.into(),
            self.inhibit_time.into(),
            self.event_timer_ms.into(),
            self.sync_start_value.into(),
        ]
    }

    /// The PDO with these stored parameters, if they are legal and all its values exist.
    pub(super) fn from_stored(
        stored: &[[u8; 4]],
        direction: Direction,
        objects: &'static [Entry],
    ) -> Option<Self> {
        let (parameters, mapping) = stored.split_at_checked(Self::stored_parameters(direction))?;
        let mut numbers = [0; 5];
        for (number, parameter) in numbers.iter_mut().zip(parameters) {
            *number = u32::from_le_bytes(*parameter);
        }
        let [cob_id, transmission_type, inhibit_time, event_timer_ms, sync_start_value] = numbers;
        let is_legal = is_transmission_type(transmission_type.try_into().ok()?)
            && inhibit_time.max(event_timer_ms) <= u16::MAX.into()
            && sync_start_value <= 240;
        Some(Self {
            cob_id: CobId::from_stored(cob_id & !NO_REMOTE_FRAME)?,
            is_bit_30_changed: cob_id & NO_REMOTE_FRAME != 0,
            mapping: Mapping::from_stored(mapping, direction, objects)?,
            transmission_type: transmission_type as u8,
            inhibit_time: inhibit_time as u16,
            event_timer_ms: event_timer_ms as u16,
            sync_start_value: sync_start_value as u8,
        })
        .filter(|_| is_legal)
    }

    /// The value of a sub-index of the communication parameter.
    pub(super) fn parameter(
        &self,
        direction: Direction,
        sub_index: u8,
        base: Option<u16>,
        node: Option<NodeId>,
    ) -> u32 {
        match (sub_index, direction) {
            (1, _) => {
                let is_set = self.is_bit_30_changed != (direction == Direction::Transmit);
                self.cob_id.value(base, node) | if is_set { NO_REMOTE_FRAME } else { 0 }
            }
            (2, _) => self.transmission_type.into(),
            (3, _) => self.inhibit_time.into(),
            (5, _) => self.event_timer_ms.into(),
            _ => self.sync_start_value.into(),
        }
    }

    /// Sets a sub-index of the communication parameter.
    ///
    /// # Errors
    /// [`Abort::InvalidValue`], or [`Abort::DeviceState`] for what a valid PDO does not allow.
    pub(super) fn set_parameter(
        &mut self,
        direction: Direction,
        sub_index: u8,
        value: u32,
        base: Option<u16>,
        node: Option<NodeId>,
    ) -> Result<(), Abort> {
        match sub_index {
            1 => {
                self.cob_id.set(value & !NO_REMOTE_FRAME, base, node)?;
                let is_set = value & NO_REMOTE_FRAME != 0;
                self.is_bit_30_changed = is_set != (direction == Direction::Transmit);
            }
            2 if !is_transmission_type(value as u8) => return Err(Abort::InvalidValue),
            2 => self.transmission_type = value as u8,
            5 => self.event_timer_ms = value as u16,
            _ if self.cob_id.is_valid => return Err(Abort::DeviceState),
            3 => self.inhibit_time = value as u16,
            _ if value > 240 => return Err(Abort::InvalidValue),
            _ => self.sync_start_value = value as u8,
        }
        Ok(())
    }

    /// Sets a sub-index of the mapping.
    ///
    /// # Errors
    /// [`Abort::UnsupportedAccess`] while the PDO is valid, or those of [`Mapping::set`].
    pub(super) fn set_mapping(
        &mut self,
        direction: Direction,
        sub_index: u8,
        value: u32,
        objects: &'static [Entry],
    ) -> Result<(), Abort> {
        if self.cob_id.is_valid {
            return Err(Abort::UnsupportedAccess);
        }
        self.mapping.set(direction, sub_index, value, objects)
    }
}
