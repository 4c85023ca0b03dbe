//! The parameters of communication that 1010h stores (CiA 301, 7.5.2.13): numbers, and each PDO as a whole.

use crate::{
    Application,
    cob_id::CobId,
    count::Declares,
    emergency,
    heartbeat::Producers,
    nmt::ErrorBehaviour,
    numbers::Numbers,
    object_dictionary::{
        DataType::{Unsigned8, Unsigned16, Unsigned32},
        Entry,
    },
    pdo::{self, Pdos},
    settings::parameters::{HEADER, Packer, Parameter},
};

const U8: u8 = Unsigned8 as u8;
const U16: u8 = Unsigned16 as u8;
const U32: u8 = Unsigned32 as u8;

/// The parameters that 1010h stores.
#[derive(Clone, Copy, Debug)]
pub(super) struct Configuration<N: Numbers> {
    pub pdos: pdo::Configuration<N>,
    pub producers: Producers<N>,
    pub heartbeat_ms: u16,
    pub error_behaviour: ErrorBehaviour,
    pub emergency: emergency::Configuration,
}

impl<N: Numbers> Configuration<N> {
    /// The greatest number of bytes that the stored parameters take.
    pub const STORED_LEN: usize = {
        let of_every_node = 4 * HEADER + 2 + 1 + 4 + 2;
        let of_sync = if Pdos::<N>::IS_USED { 4 * HEADER + 4 + 1 + 4 + 4 } else { 0 };
        let of_rpdos = N::RPDOS * (HEADER + 2) + pdo::Configuration::<N>::STORED_LEN;
        of_every_node + of_sync + N::PRODUCERS * (HEADER + 4) + of_rpdos
    };

    /// The parameters of a new device with this producer heartbeat time.
    pub const fn declared<A: Application>(heartbeat_ms: u16) -> Self
    where
        N: Declares<A>,
    {
        const {
            assert!(
                N::TPDOS + N::RPDOS + N::PRODUCERS == 0 || !A::OBJECTS.is_empty(),
                "process data and the heartbeat consumer need an application with objects"
            );
        }
        Self {
            pdos: pdo::Configuration::new(N::DECLARED_TPDOS, N::DECLARED_RPDOS),
            producers: Producers::new(N::DECLARED_PRODUCERS),
            heartbeat_ms,
            error_behaviour: A::ERROR_BEHAVIOUR,
            emergency: emergency::Configuration::DEFAULT,
        }
    }

    /// Packs the parameters. A number at its default is left out, unless the application may declare another default.
    pub fn save<A: Application>(&self, to: &mut Packer<'_>) {
        // Taking an RPDO sets its event timer to 0.
        self.pdos.save(to);
        let mut put = |index, sub_index, data_type, value: &[u8], is_stored| {
            if is_stored {
                to.put(&Parameter { index, sub_index, data_type, value });
            }
        };
        let Self { heartbeat_ms, error_behaviour, emergency, .. } = *self;
        let is_default = [error_behaviour, A::ERROR_BEHAVIOUR] == [ErrorBehaviour::DEFAULT; 2];
        put(0x1017, 0, U16, &heartbeat_ms.to_le_bytes(), true);
        put(0x1029, 1, U8, &[error_behaviour as u8], !is_default);
        let emergency::Configuration { cob_id, inhibit_time } = emergency;
        let is_moved = cob_id != emergency::Configuration::DEFAULT.cob_id;
        put(0x1014, 0, U32, &cob_id.stored().to_le_bytes(), is_moved);
        put(0x1015, 0, U16, &inhibit_time.to_le_bytes(), inhibit_time != 0);
        for (sub_index, producer) in (1..).zip(self.producers.values()) {
            let is_declared = usize::from(sub_index) <= A::WATCHED.len();
            put(0x1016, sub_index, U32, &producer.to_le_bytes(), is_declared || producer != 0);
        }
        if Pdos::<N>::IS_USED {
            let sync = &self.pdos.sync;
            put(0x1005, 0, U32, &u32::from(sync.cob_id()).to_le_bytes(), true);
            // A counter is taken only before the period.
            put(0x1019, 0, U8, &[sync.overflow()], true);
            put(0x1006, 0, U32, &sync.period.to_le_bytes(), sync.period != 0);
            put(0x1007, 0, U32, &sync.window.to_le_bytes(), sync.window != 0);
        }
        for (index, rpdo) in (0x1400..).zip(self.pdos.rpdos()) {
            put(index, 5, U16, &rpdo.event_timer_ms.to_le_bytes(), rpdo.event_timer_ms != 0);
        }
    }

    /// Takes a stored parameter, if it belongs to communication and is legal.
    pub fn take(&mut self, parameter: &Parameter<'_>, objects: &'static [Entry]) -> Option<()> {
        let Parameter { index, sub_index, data_type, value } = *parameter;
        let number_16 = || value.try_into().ok().map(u16::from_le_bytes);
        let number_32 = || value.try_into().ok().map(u32::from_le_bytes);
        match (index, sub_index, data_type) {
            (0x1017, 0, U16) => self.heartbeat_ms = number_16()?,
            (0x1029, 1, U8) => self.error_behaviour = ErrorBehaviour::new(*value.first()?)?,
            (0x1014, 0, U32) => self.emergency.cob_id = CobId::from_stored(number_32()?)?,
            (0x1015, 0, U16) => self.emergency.inhibit_time = number_16()?,
            (0x1016, 1.., U32) => self.producers.set(sub_index, number_32()?).ok()?,
            _ if !Pdos::<N>::IS_USED => return None,
            (0x1005, 0, U32) => self.pdos.sync.set_cob_id(number_32()?).ok()?,
            (0x1019, 0, U8) => self.pdos.sync.set_overflow(*value.first()?).ok()?,
            (0x1006, 0, U32) => self.pdos.sync.period = number_32()?,
            (0x1007, 0, U32) => self.pdos.sync.window = number_32()?,
            (0x1400..0x1600, 5, U16) => self.pdos.rpdo(index)?.event_timer_ms = number_16()?,
            _ => self.pdos.take(parameter, objects)?,
        }
        Some(())
    }
}
