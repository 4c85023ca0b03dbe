//! The parameters of communication that 1010h stores beside the settings: each entry of 1016h, 1005h, 1019h, 1029h, and
//! each PDO as a whole.

use super::{
    ProcessData,
    heartbeats::Producer,
    mapping::MAX_MAPPED,
    rpdo::{RECEIVE_PARAMETERS, ReceivePdo},
    sync::Sync,
    tables::{
        CONSUMER_HEARTBEAT_TIME, RPDO_MAPPING, RPDO_PARAMETER, SYNC_COB_ID, SYNC_COUNTER_OVERFLOW,
        TPDO_MAPPING, TPDO_PARAMETER,
    },
    tpdo::{TRANSMIT_PARAMETERS, TransmitPdo},
};
use crate::{
    Application,
    nmt::ErrorBehaviour,
    object_dictionary::{DataType, Entry},
    settings::parameters::{HEADER, Packer, Parameter},
};

const U8: u8 = DataType::Unsigned8 as u8;
const U32: u8 = DataType::Unsigned32 as u8;
/// The data type of a stored PDO: PDO_COMMUNICATION_PARAMETER (CiA 301, 7.4.8.1), here followed by the mapping.
const PDO: u8 = 0x20;
const ERROR_BEHAVIOUR: u16 = 0x1029;
const COMMUNICATION_ERROR: u8 = 1;

/// The parameters of process data, with nothing received or sent yet.
#[derive(Clone, Copy, Debug)]
pub(super) struct Configuration<const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize> {
    pub tpdos: [TransmitPdo; TPDOS],
    pub rpdos: [ReceivePdo; RPDOS],
    pub producers: [Producer; PRODUCERS],
    pub sync: Sync,
    pub error_behaviour: ErrorBehaviour,
}

impl<const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize>
    ProcessData<TPDOS, RPDOS, PRODUCERS>
{
    /// Whether parameters of communication are stored beside the settings: the node has process data, or the
    /// application has stored values.
    const fn is_stored<A: Application>() -> bool {
        Self::IS_USED || A::STORED_LEN > 0
    }

    /// The greatest number of bytes that the stored parameters take.
    pub const fn stored_len<A: Application>() -> usize {
        let of_sync = if Self::HAS_PDOS { HEADER + 4 + HEADER + 1 } else { 0 };
        let of_error_behaviour = if Self::is_stored::<A>() { HEADER + 1 } else { 0 };
        of_sync
            + of_error_behaviour
            + PRODUCERS * (HEADER + 4)
            + RPDOS * (HEADER + 4 * (RECEIVE_PARAMETERS + MAX_MAPPED))
            + TPDOS * (HEADER + 4 * (TRANSMIT_PARAMETERS + MAX_MAPPED))
    }

    /// The parameters to which a reset returns.
    pub(super) fn persistent<A: Application>(&self) -> Configuration<TPDOS, RPDOS, PRODUCERS> {
        self.persistent.unwrap_or_else(Self::declared::<A>)
    }

    /// The error behaviour to which a reset returns.
    pub const fn error_behaviour<A: Application>(&self) -> ErrorBehaviour {
        match &self.persistent {
            Some(persistent) if Self::is_stored::<A>() => persistent.error_behaviour,
            _ => ErrorBehaviour::DEFAULT,
        }
    }

    /// Takes a stored parameter in place of the declared one, if it belongs to communication and is legal. A PDO with a
    /// value that cannot be mapped stays as it is declared. Returns whether the parameter was taken.
    pub fn restore<A: Application>(&mut self, parameter: &Parameter<'_>) -> bool {
        if !Self::is_stored::<A>() {
            return false;
        }
        let persistent = self.persistent.get_or_insert_with(Self::declared::<A>);
        let is_taken = persistent.take(parameter, A::OBJECTS).is_some();
        self.reset::<A>();
        is_taken
    }

    /// The current parameters.
    fn configuration(
        &self,
        error_behaviour: ErrorBehaviour,
    ) -> Configuration<TPDOS, RPDOS, PRODUCERS> {
        let Self { tpdos, rpdos, producers, sync, .. } = *self;
        let mut configuration = Configuration { tpdos, rpdos, producers, sync, error_behaviour };
        configuration.tpdos.iter_mut().for_each(TransmitPdo::restart);
        configuration.rpdos.iter_mut().for_each(ReceivePdo::restart);
        configuration.producers.iter_mut().for_each(Producer::forget);
        configuration.sync.forget();
        configuration
    }

    /// Begins a store of the current parameters.
    pub fn stage<A: Application>(&mut self, error_behaviour: ErrorBehaviour) {
        if Self::is_stored::<A>() {
            self.staged = Some(self.configuration(error_behaviour));
        }
    }

    /// Begins a store that removes the parameters, so that the declared ones apply.
    pub fn stage_declared<A: Application>(&mut self) {
        if Self::is_stored::<A>() {
            self.staged = Some(Self::declared::<A>());
        }
    }

    /// Packs the parameters of the store in progress.
    pub fn save<A: Application>(&self, to: &mut Packer<'_>) {
        if Self::is_stored::<A>()
            && let Some(staged) = &self.staged
        {
            staged.save(to);
        }
    }

    /// Ends the store in progress, if it concerns these parameters.
    pub fn end_store<A: Application>(&mut self, is_done: bool) {
        if Self::is_stored::<A>()
            && let Some(staged) = self.staged.take()
            && is_done
        {
            self.persistent = Some(staged);
        }
    }
}

impl<const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize>
    Configuration<TPDOS, RPDOS, PRODUCERS>
{
    fn save(&self, to: &mut Packer<'_>) {
        if TPDOS + RPDOS > 0 {
            put(to, SYNC_COB_ID, 0, U32, &u32::from(self.sync.cob_id()).to_le_bytes());
            put(to, SYNC_COUNTER_OVERFLOW, 0, U8, &[self.sync.overflow()]);
        }
        if self.error_behaviour != ErrorBehaviour::DEFAULT {
            let value = [self.error_behaviour as u8];
            put(to, ERROR_BEHAVIOUR, COMMUNICATION_ERROR, U8, &value);
        }
        // An entry that is not stored is 0.
        let used = (1..).zip(&self.producers).filter(|(_, producer)| producer.value() != 0);
        for (sub_index, producer) in used {
            put(to, CONSUMER_HEARTBEAT_TIME, sub_index, U32, &producer.value().to_le_bytes());
        }
        for (index, rpdo) in (RPDO_PARAMETER..).zip(&self.rpdos) {
            put_pdo(to, index, rpdo.stored());
        }
        for (index, tpdo) in (TPDO_PARAMETER..).zip(&self.tpdos) {
            put_pdo(to, index, tpdo.stored());
        }
    }

    fn take(&mut self, parameter: &Parameter<'_>, objects: &[Entry]) -> Option<()> {
        let Parameter { index, sub_index, data_type, value } = *parameter;
        match (index, sub_index, data_type) {
            (SYNC_COB_ID, 0, U32) if TPDOS + RPDOS > 0 => self.sync.set_cob_id(number(value)?).ok(),
            (SYNC_COUNTER_OVERFLOW, 0, U8) if TPDOS + RPDOS > 0 => {
                let &[overflow] = value else { return None };
                self.sync.set_overflow(overflow).ok()
            }
            (ERROR_BEHAVIOUR, COMMUNICATION_ERROR, U8) => {
                let &[value] = value else { return None };
                self.error_behaviour = ErrorBehaviour::new(value)?;
                Some(())
            }
            (CONSUMER_HEARTBEAT_TIME, 1.., U32) => {
                let at = usize::from(sub_index).wrapping_sub(1);
                Producer::set(&mut self.producers, at, number(value)?).ok()
            }
            (RPDO_PARAMETER..RPDO_MAPPING, 0, PDO) => {
                let rpdo = self.rpdos.get_mut(usize::from(index.wrapping_sub(RPDO_PARAMETER)))?;
                *rpdo = ReceivePdo::from_stored(words(value)?, objects)?;
                Some(())
            }
            (TPDO_PARAMETER..TPDO_MAPPING, 0, PDO) => {
                let tpdo = self.tpdos.get_mut(usize::from(index.wrapping_sub(TPDO_PARAMETER)))?;
                *tpdo = TransmitPdo::from_stored(words(value)?, objects)?;
                Some(())
            }
            _ => None,
        }
    }
}

fn put(to: &mut Packer<'_>, index: u16, sub_index: u8, data_type: u8, value: &[u8]) {
    to.put(&Parameter { index, sub_index, data_type, value });
}

fn put_pdo(to: &mut Packer<'_>, index: u16, stored: impl Iterator<Item = u32> + Clone) {
    to.put_with(index, 0, PDO, 4 * stored.clone().count(), |value| {
        for (to, number) in value.as_chunks_mut().0.iter_mut().zip(stored) {
            *to = number.to_le_bytes();
        }
    });
}

fn number(value: &[u8]) -> Option<u32> {
    value.try_into().ok().map(u32::from_le_bytes)
}

fn words(value: &[u8]) -> Option<&[[u8; 4]]> {
    match value.as_chunks() {
        (words, []) => Some(words),
        _ => None,
    }
}
