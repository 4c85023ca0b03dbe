//! The values that 1010h stores (CiA 301, 7.5.2.13): those of rows with this option, and each PDO as a whole.

use lss_slave::bytes::copy;

use super::{
    Node, START,
    areas::{Area, Change},
    communication::Communication,
    objects::NodeObjects,
    product::{Persistent, Product},
    verification::Stamp,
};
use crate::{
    Application,
    cob_id::CobId,
    emergency,
    nmt::ErrorBehaviour,
    numbers::Numbers,
    object_dictionary::{self, Entry, Object, TABLE},
    pdo::{self, Pdos},
    settings::parameters::{self, HEADER, Packer, Parameter},
};

/// The greatest number of bytes that the stored values of the node take.
pub(super) const fn len<A: Application>() -> usize {
    let mut sum = len_of(TABLE);
    if Communication::<A::Numbers>::IS_USED {
        let mut tables: &[&[Entry]] = &A::Numbers::TABLES;
        while let [table, others @ ..] = tables {
            sum += len_of(table);
            tables = others;
        }
        sum += pdo::Configuration::<A::Numbers>::STORED_LEN;
    }
    sum
}

/// The number of bytes that the stored values of a table take.
const fn len_of(mut table: &[Entry]) -> usize {
    let mut sum = 0;
    while let [entry, others @ ..] = table {
        if entry.options.is_stored() {
            sum += HEADER + entry.data_type.size() as usize;
        }
        table = others;
    }
    sum
}

impl<A: Application> Node<A> {
    /// Makes these packed parameters the persistent ones, after a store with this effect on communication.
    ///
    /// To unpack the parameters of communication takes 0.1 ms and more, while no frame is received. So it is done only if
    /// one of them has changed since they were packed.
    pub(super) fn replace_persistent(&mut self, parameters: &[u8], of_communication: Change) {
        let Product { device, communication, persistent, .. } = &mut self.product;
        let is_unpacked = match of_communication {
            Change::Keep => false,
            Change::Renew if self.storing.is_as_packed => {
                *persistent = Persistent {
                    heartbeat_ms: self.nmt.heartbeat_ms(),
                    error_behaviour: self.nmt.error_behaviour(),
                    emergency: self.emergency.configuration,
                };
                communication.keep_current();
                false
            }
            Change::Renew | Change::Remove => {
                *persistent = Persistent::declared::<A>(device.heartbeat_ms);
                communication.forget_stored::<A>();
                true
            }
        };
        self.storing.verification.persistent = Stamp::NONE;
        let mut objects = self.objects(START).0;
        for parameter in parameters::unpack(parameters) {
            match Area::of(parameter.index) {
                Area::Communication if !is_unpacked => {}
                Area::Communication | Area::Verification => _ = objects.take(&parameter),
                Area::Application => {}
            }
        }
    }

    /// Gives the parameters of communication their persistent values.
    pub(super) fn reset_parameters(&mut self) {
        let Persistent { heartbeat_ms, error_behaviour, emergency } = self.product.persistent;
        self.nmt.configure(heartbeat_ms, error_behaviour);
        self.emergency.configure(emergency);
        self.product.communication.reset();
        self.storing.is_as_packed = false;
    }
}

impl<A: Application> NodeObjects<'_, A> {
    /// Packs the current values of an area.
    pub fn save(&mut self, area: Area, to: &mut Packer<'_>) {
        if Pdos::<A::Numbers>::IS_USED && area == Area::Communication {
            // Taking an RPDO sets its event timer to 0.
            self.product.communication.pdos.save(to);
        }
        self.save_rows(TABLE, area, to);
        if Communication::<A::Numbers>::IS_USED {
            // A counter is taken only before the period.
            A::Numbers::TABLES.into_iter().rev().for_each(|table| self.save_rows(table, area, to));
        }
    }

    /// Packs the current values of a table in an area. A number at its default is left out, unless the application may
    /// declare another default.
    fn save_rows(&mut self, table: &[Entry], area: Area, to: &mut Packer<'_>) {
        let is_stored = |entry: &&Entry| entry.options.is_stored() && Area::of(entry.index) == area;
        for entry in table.iter().filter(is_stored) {
            let number = match entry.object {
                Object::CobIdEmergency => self.emergency.configuration.cob_id.stored(),
                _ => self.number(entry).unwrap_or_default(),
            };
            let is_default = match entry.object {
                Object::ProducerHeartbeatTime | Object::SyncCounterOverflow => false,
                Object::CommunicationErrorBehaviour => {
                    [number, A::ERROR_BEHAVIOUR as u32] == [ErrorBehaviour::DEFAULT as u32; 2]
                }
                Object::ConsumerHeartbeatTime(sub_index) => {
                    number == 0 && usize::from(sub_index) > A::WATCHED.len()
                }
                Object::CobIdEmergency => {
                    number == emergency::Configuration::DEFAULT.cob_id.stored()
                }
                _ => number == 0,
            };
            if !is_default {
                let len = entry.data_type.size().into();
                let place = to.reserve(entry.index, entry.sub_index, entry.data_type as u8, len);
                copy(&number.to_le_bytes(), 0, place);
            }
        }
    }

    /// Takes a persistent value of the node, if it has it with this data type and the value is legal.
    pub fn take(&mut self, parameter: &Parameter<'_>) -> Option<()> {
        let Parameter { index, sub_index, data_type, value } = *parameter;
        let table = Communication::<A::Numbers>::table(index).unwrap_or(TABLE);
        let entry = object_dictionary::find(table, index, sub_index).ok()?;
        let Product { communication, persistent, .. } = self.product;
        if !entry.options.is_stored() {
            return match Pdos::<A::Numbers>::IS_USED {
                true => communication.pdos.persistent.take(parameter, A::OBJECTS),
                false => None,
            };
        }
        if entry.data_type as u8 != data_type || usize::from(entry.data_type.size()) != value.len()
        {
            return None;
        }
        let number = value.iter().rev().fold(0, |number, byte| number << 8 | u32::from(*byte));
        match entry.object {
            Object::ProducerHeartbeatTime => persistent.heartbeat_ms = number as u16,
            Object::CommunicationErrorBehaviour => {
                persistent.error_behaviour = ErrorBehaviour::new(number as u8)?;
            }
            Object::CobIdEmergency => persistent.emergency.cob_id = CobId::from_stored(number)?,
            Object::InhibitTimeEmergency => persistent.emergency.inhibit_time = number as u16,
            Object::VerifyConfiguration(sub_index) => {
                self.storing.verification.persistent.write(sub_index, number);
            }
            Object::ConsumerHeartbeatTime(sub_index) => {
                communication.consumer.persistent.set(sub_index, number).ok()?;
            }
            object if Pdos::<A::Numbers>::IS_USED => {
                communication.pdos.persistent.take_row(object, number)?;
            }
            _ => return None,
        }
        Some(())
    }
}
