//! What the objects of an update answer: abort codes, the status 1F57h, the state 2001h.

use crate::{flash::FlashError, header::Field};

/// An object of program download (CiA 302-3), or the state of the update.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Object {
    /// 1F51h sub-index 1, `UNSIGNED8`: program control.
    Control,
    /// 1F56h sub-index 1, `UNSIGNED32`: the CRC-32 of the program, 0 without one.
    Software,
    /// 1F57h sub-index 1, `UNSIGNED32`: flash status.
    FlashStatus,
    /// 2001h sub-index 1, `UNSIGNED8`: a [`State`].
    State,
    /// 2001h sub-index 2, `UNSIGNED8`: the starts of a program on trial.
    Starts,
}

/// Why an SDO request is refused, with the abort code of CiA 301.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Abort {
    /// There is no room for the data now.
    Memory = 0x0504_0005,
    /// The flash failed, or the program is not the one in the header.
    Hardware = 0x0606_0000,
    /// There is no such value of 1F51h.
    InvalidValue = 0x0609_0030,
    /// The header does not fit the device: nothing was written.
    NotStored = 0x0800_0020,
    /// The state of the device does not allow it.
    DeviceState = 0x0800_0022,
}

/// How the last clear or download ended, or why the last request was refused: 1F57h.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Status {
    /// 0: no error.
    #[default]
    Ok,
    /// 1: there is no valid program.
    NoProgram,
    /// 2: a field of the header does not fit this device.
    Refused(Field),
    /// 3: length, CRC, hash or vectors of the program are wrong.
    Damaged(Field),
    /// 4: not cleared.
    NotCleared,
    /// 5: the flash could not be erased or written.
    WriteFailed,
    /// 6: the program is longer than its place.
    TooLong,
    /// 7: the flash is write-protected.
    Protected,
    /// 8: the supply is too low to write the flash.
    SupplyLow,
    /// 9: the program has failed [too often](crate::start::MOST_FAILURES), and is tried again after 60 s.
    Failing,
}

impl From<FlashError> for Status {
    fn from(error: FlashError) -> Self {
        match error {
            FlashError::Failed => Self::WriteFailed,
            FlashError::Protected => Self::Protected,
            FlashError::SupplyLow => Self::SupplyLow,
        }
    }
}

impl Status {
    /// Whether the flash is the cause.
    pub(crate) const fn is_of_flash(self) -> bool {
        matches!(self, Self::WriteFailed | Self::Protected | Self::SupplyLow)
    }

    /// The value of 1F57h: busy in bit 0, the status in bits 1 to 7, the header field in bits 16 to 31.
    pub const fn value(self, busy: bool) -> u32 {
        let (status, field) = match self {
            Self::Ok => (0, 0),
            Self::NoProgram => (1, 0),
            Self::Refused(field) => (2, field as u32),
            Self::Damaged(field) => (3, field as u32),
            Self::NotCleared => (4, 0),
            Self::WriteFailed => (5, 0),
            Self::TooLong => (6, Field::Length as u32),
            Self::Protected => (7, 0),
            Self::SupplyLow => (8, 0),
            Self::Failing => (9, 0),
        };
        field << 16 | status << 1 | busy as u32
    }
}

/// Where an update is: 2001h sub-index 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// No update since the device was made.
    None = 0,
    /// RUN was or is being erased; the new program is not complete.
    UnderWay = 1,
    /// The new program is complete and not confirmed.
    Trial = 2,
    /// The new program was confirmed.
    Kept = 3,
    /// The program before was restored.
    Restored = 4,
}
