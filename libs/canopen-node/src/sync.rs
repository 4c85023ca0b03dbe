//! The SYNC consumer (CiA 301, 7.2.5): 1005h to 1007h and 1019h.

use lss_slave::cob_id;

use crate::{
    Frame, Instant,
    cob_id::is_restricted,
    object_dictionary::{
        Access::ReadWrite,
        DataType::{Unsigned8, Unsigned32},
        DefaultValue, Description, Entry, Number, Object, row,
    },
    sdo::Abort,
};

const COB_ID: u16 = 0x1005;
const CYCLE_PERIOD: u16 = 0x1006;
const WINDOW_LENGTH: u16 = 0x1007;
const COUNTER_OVERFLOW: u16 = 0x1019;
/// The highest counter that a master can choose.
const MAX_OVERFLOW: u8 = 240;

pub(crate) const ROWS: &[Entry] = &[
    row(COB_ID, 0, Unsigned32, ReadWrite, Object::SyncCobId).stored(),
    row(CYCLE_PERIOD, 0, Unsigned32, ReadWrite, Object::CommunicationCyclePeriod).stored(),
    row(WINDOW_LENGTH, 0, Unsigned32, ReadWrite, Object::SynchronousWindowLength).stored(),
];
pub(crate) const COUNTER_OVERFLOW_ROW: &[Entry] =
    &[row(COUNTER_OVERFLOW, 0, Unsigned8, ReadWrite, Object::SyncCounterOverflow).stored()];

/// The error code of a SYNC whose length does not fit 1019h.
pub(crate) const WRONG_LENGTH: u16 = crate::emergency::own::SYNC_LENGTH.code;

/// The parameters of the SYNC consumer.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sync {
    cob_id: u16,
    /// 1006h: the time between two SYNCs in microseconds, which only a producer needs.
    period: u32,
    /// 1007h: the time after a SYNC in which synchronous PDOs are exchanged, in microseconds; 0: until the next SYNC.
    window: u32,
    /// 1019h: 0, or the highest counter.
    overflow: u8,
}

/// A SYNC with a wrong length, which is ignored.
pub(crate) struct WrongLength;

impl Sync {
    pub const fn new() -> Self {
        Self { cob_id: cob_id::SYNC, period: 0, window: 0, overflow: 0 }
    }

    pub const fn cob_id(&self) -> u16 {
        self.cob_id
    }

    /// The counter of a SYNC, if it has one.
    ///
    /// # Errors
    /// [`WrongLength`].
    pub fn counter(&self, frame: &Frame) -> Result<Option<u8>, WrongLength> {
        match (frame.data(), self.overflow) {
            ([], 0) => Ok(None),
            (&[counter], 1..) => Ok(Some(counter)),
            _ => Err(WrongLength),
        }
    }

    /// The value of an object, if it is one of SYNC.
    pub fn read(&self, object: Object) -> Option<u32> {
        Some(match object {
            Object::SyncCobId => self.cob_id.into(),
            Object::CommunicationCyclePeriod => self.period,
            Object::SynchronousWindowLength => self.window,
            Object::SyncCounterOverflow => self.overflow.into(),
            _ => return None,
        })
    }

    /// Sets an object of SYNC.
    ///
    /// # Errors
    /// Those of its value; [`Abort::NoObject`] for an object of another service.
    pub fn write(&mut self, object: Object, value: u32) -> Result<(), Abort> {
        match object {
            Object::SyncCobId => self.set_cob_id(value)?,
            Object::CommunicationCyclePeriod => self.period = value,
            Object::SynchronousWindowLength => self.window = value,
            Object::SyncCounterOverflow => self.set_overflow(value as u8)?,
            _ => return Err(Abort::NoObject),
        }
        Ok(())
    }

    /// Sets 1005h.
    ///
    /// # Errors
    /// [`Abort::InvalidValue`] for a producer (bit 30), a 29-bit identifier or a restricted CAN-ID.
    fn set_cob_id(&mut self, value: u32) -> Result<(), Abort> {
        const NO_MEANING: u32 = 1 << 31;
        let id = (value & 0x7FF) as u16;
        if value & !(NO_MEANING | 0x7FF) != 0 || is_restricted(id) {
            return Err(Abort::InvalidValue);
        }
        self.cob_id = id;
        Ok(())
    }

    /// Sets 1019h.
    ///
    /// # Errors
    /// [`Abort::InvalidValue`] unless it is 0 or 2 to 240; [`Abort::DeviceState`] for another one while 1006h is not 0.
    fn set_overflow(&mut self, overflow: u8) -> Result<(), Abort> {
        if !matches!(overflow, 0 | 2..=MAX_OVERFLOW) {
            return Err(Abort::InvalidValue);
        }
        if overflow != self.overflow && self.period != 0 {
            return Err(Abort::DeviceState);
        }
        self.overflow = overflow;
        Ok(())
    }

    /// The end of the synchronous window after a SYNC at `now`, if there is one. One of more than half an hour does not
    /// end between two SYNCs of any use.
    pub const fn window_end(&self, now: Instant) -> Option<Instant> {
        const LONGEST: u32 = 1800 * 1_000_000;
        match self.window {
            length @ 1..=LONGEST => Some(now.plus_micros(length)),
            _ => None,
        }
    }
}

/// The description of a row of SYNC.
pub(crate) fn describe(entry: &Entry, default: DefaultValue) -> Description {
    let (name, limits) = match entry.index {
        COB_ID => ("COB-ID SYNC", None),
        CYCLE_PERIOD => ("Communication cycle period", None),
        WINDOW_LENGTH => ("Synchronous window length", None),
        _ => {
            let limits = (Number::Integer(0), Number::Integer(MAX_OVERFLOW.into()));
            ("Synchronous counter overflow value", Some(limits))
        }
    };
    Description { object: None, name: name.into(), default, limits }
}
