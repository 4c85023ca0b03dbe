//! The SDO server (CiA 301, 7.2.4): expedited and segmented transfer in both directions, and block transfer where the
//! dictionary has an object that is long enough for it.

mod block_download;
mod block_upload;
mod crc;
mod download;
mod objects;
mod server;
mod upload;

use core::{error, fmt};

use crate::{
    lss::StoreError,
    object_dictionary::{Entry, Missing},
};
pub(crate) use block_download::BLOCK_SIZE;
pub use objects::Answer;
pub(crate) use objects::{Buffer, Content, Objects};
pub(crate) use server::Server;

#[doc(inline)]
pub use lss_slave::cob_id::SDO_REQUEST as REQUEST_COB_ID;

/// The base COB-ID of answers, to which the node-ID is added.
pub const RESPONSE_COB_ID: u16 = 0x580;

/// The reason for an abort, with the code that is sent to the client (CiA 301, table 22).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
#[repr(u32)]
pub enum Abort {
    /// The segment repeats the toggle bit of the one before.
    Toggle = 0x0503_0000,
    /// The client has been silent for too long.
    Timeout = 0x0504_0000,
    /// The command is unknown, not supported or not expected.
    Command = 0x0504_0001,
    /// The block size is not 1..=127.
    BlockSize = 0x0504_0002,
    /// The sequence number belongs to no segment of the block.
    SequenceNumber = 0x0504_0003,
    /// The CRC does not fit the data.
    Crc = 0x0504_0004,
    /// There is no memory for the data.
    Memory = 0x0504_0005,
    /// The object cannot be written now: a mapping of a PDO that is valid, or an entry of one that is in use.
    UnsupportedAccess = 0x0601_0000,
    /// A write-only object was read.
    WriteOnly = 0x0601_0001,
    /// A read-only object was written.
    ReadOnly = 0x0601_0002,
    /// The object does not exist.
    NoObject = 0x0602_0000,
    /// The object does not exist or cannot be mapped into this PDO.
    NotMappable = 0x0604_0041,
    /// The mapped objects are longer, or more, than a PDO can carry.
    TooManyMapped = 0x0604_0042,
    /// The value does not go with other values.
    Incompatible = 0x0604_0043,
    /// The hardware failed: the settings could not be written.
    Hardware = 0x0606_0000,
    /// The data is longer than the object, or than its sender has announced.
    TooLong = 0x0607_0012,
    /// The data is shorter than the object, or than its sender has announced.
    TooShort = 0x0607_0013,
    /// The object exists, the sub-index does not.
    NoSubIndex = 0x0609_0011,
    /// The value is out of the object's range.
    InvalidValue = 0x0609_0030,
    /// The value is above the object's upper limit.
    TooHigh = 0x0609_0031,
    /// The value is below the object's lower limit.
    TooLow = 0x0609_0032,
    /// The signature is not "save" or "load" as the object requires.
    NotStored = 0x0800_0020,
    /// Another store is under way.
    Busy = 0x0800_0021,
    /// The state of the device does not allow it.
    DeviceState = 0x0800_0022,
    /// The object exists, but has no data now.
    NoData = 0x0800_0024,
}

impl fmt::Display for Abort {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let reason = match self {
            Self::Toggle => "the toggle bit has not changed",
            Self::Timeout => "the client has been silent for too long",
            Self::Command => "unknown command",
            Self::BlockSize => "invalid block size",
            Self::SequenceNumber => "invalid sequence number",
            Self::Crc => "wrong CRC",
            Self::Memory => "no memory for the data",
            Self::UnsupportedAccess => "the object cannot be written now",
            Self::WriteOnly => "the object can only be written",
            Self::ReadOnly => "the object can only be read",
            Self::NoObject => "no such object",
            Self::NotMappable => "the object cannot be mapped into the PDO",
            Self::TooManyMapped => "the mapped objects are more than a PDO can carry",
            Self::Incompatible => "the value does not go with other values",
            Self::Hardware => "the hardware failed",
            Self::TooLong => "too much data",
            Self::TooShort => "too little data",
            Self::NoSubIndex => "no such sub-index",
            Self::InvalidValue => "invalid value",
            Self::TooHigh => "the value is above the upper limit",
            Self::TooLow => "the value is below the lower limit",
            Self::NotStored => "wrong signature",
            Self::Busy => "another store is under way",
            Self::DeviceState => "the state of the device does not allow it",
            Self::NoData => "no data available",
        };
        write!(f, "{reason} ({:08X}h)", *self as u32)
    }
}

impl error::Error for Abort {}

/// Index and sub-index of an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Address {
    index: u16,
    sub_index: u8,
}

impl Address {
    /// The address in an answer to a segment that belongs to no transfer.
    const NONE: Self = Self { index: 0, sub_index: 0 };

    const fn of(entry: &Entry) -> Self {
        Self { index: entry.index, sub_index: entry.sub_index }
    }
}

/// A message of client or server: eight bytes, as two words so that it moves fast.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Message {
    /// The command, then the address or data.
    head: u32,
    data: u32,
}

impl Message {
    pub const fn from_bytes([b0, b1, b2, b3, b4, b5, b6, b7]: [u8; 8]) -> Self {
        let head = u32::from_le_bytes([b0, b1, b2, b3]);
        Self { head, data: u32::from_le_bytes([b4, b5, b6, b7]) }
    }

    pub const fn to_bytes(self) -> [u8; 8] {
        let [b0, b1, b2, b3] = self.head.to_le_bytes();
        let [b4, b5, b6, b7] = self.data.to_le_bytes();
        [b0, b1, b2, b3, b4, b5, b6, b7]
    }

    /// A message with an address and a number.
    const fn new(command: u8, Address { index, sub_index }: Address, number: u32) -> Self {
        let head = command as u32 | (index as u32) << 8 | (sub_index as u32) << 24;
        Self { head, data: number }
    }

    /// A message with seven bytes of data.
    const fn segment(command: u8, [b0, b1, b2, b3, b4, b5, b6]: [u8; 7]) -> Self {
        Self::from_bytes([command, b0, b1, b2, b3, b4, b5, b6])
    }

    /// The message that ends a transfer.
    const fn abort(address: Address, code: Abort) -> Self {
        Self::new(0x80, address, code as u32)
    }

    /// The message that confirms the download of an object.
    pub const fn confirmation(index: u16, sub_index: u8) -> Self {
        Self::new(0x60, Address { index, sub_index }, 0)
    }

    /// The message that ends the download of an object for this reason.
    pub const fn refusal(index: u16, sub_index: u8, code: Abort) -> Self {
        Self::abort(Address { index, sub_index }, code)
    }

    const fn command(self) -> u8 {
        self.head as u8
    }

    const fn address(self) -> Address {
        Address { index: (self.head >> 8) as u16, sub_index: (self.head >> 24) as u8 }
    }

    /// The bytes behind the command.
    const fn payload(self) -> [u8; 7] {
        let [_, payload @ ..] = self.to_bytes();
        payload
    }
}

impl From<StoreError> for Abort {
    fn from(error: StoreError) -> Self {
        match error {
            StoreError::Full => Self::DeviceState,
            _ => Self::Hardware,
        }
    }
}

impl From<Missing> for Abort {
    fn from(missing: Missing) -> Self {
        match missing {
            Missing::Object => Self::NoObject,
            Missing::SubIndex => Self::NoSubIndex,
        }
    }
}
