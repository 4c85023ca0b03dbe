//! The messages of LSS (CiA 305): requests and answers as legal values, and the eight bytes of a frame.

use core::{error, fmt};

use super::{AddressPart, REQUEST_COB_ID, RESPONSE_COB_ID};
use crate::{Frame, NodeId, settings};

/// A request of the LSS master.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Request {
    /// 04, mode 0: switches all slaves to LSS waiting state.
    SwitchToWaiting,
    /// 04, mode 1: switches all slaves to LSS configuration state.
    SwitchToConfiguration,
    /// 11: sets the pending node-ID, given as any byte, valid or not.
    ConfigureNodeId(u8),
    /// 13: sets the pending bit rate.
    ConfigureBitTiming {
        /// Table selector; 0 is the table of CiA 301.
        table: u8,
        /// Index into the selected table.
        index: u8,
    },
    /// 15: activates the pending bit rate after the switch delay, 0..=65535 ms.
    ActivateBitTiming(u16),
    /// 17: makes the pending node-ID and bit rate persistent.
    StoreConfiguration,
    /// 40..43: one step of switch state selective.
    Select(AddressPart, u32),
    /// 46..4B: one step of identify remote slave.
    Identify(IdentifyKey, u32),
    /// 4C: asks for slaves without a node-ID.
    IdentifyNonConfigured,
    /// 51: one step of Fastscan.
    Fastscan(FastscanStep),
    /// 5A..5D: asks for one part of the LSS address.
    Inquire(AddressPart),
    /// 5E: asks for the active node-ID.
    InquireNodeId,
}

/// The comparison in one step of identify remote slave (CS 46..4B).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
#[expect(missing_docs, reason = "the names say it")]
pub enum IdentifyKey {
    VendorId = 0,
    ProductCode = 1,
    RevisionNumberLow = 2,
    RevisionNumberHigh = 3,
    SerialNumberLow = 4,
    SerialNumberHigh = 5,
}

impl IdentifyKey {
    /// The key with the number 0..=5.
    const fn new(number: u8) -> Option<Self> {
        match number {
            0 => Some(Self::VendorId),
            1 => Some(Self::ProductCode),
            2 => Some(Self::RevisionNumberLow),
            3 => Some(Self::RevisionNumberHigh),
            4 => Some(Self::SerialNumberLow),
            5 => Some(Self::SerialNumberHigh),
            _ => None,
        }
    }

    /// The part of the address to compare with.
    pub(super) const fn part(self) -> AddressPart {
        match self {
            Self::VendorId => AddressPart::VendorId,
            Self::ProductCode => AddressPart::ProductCode,
            Self::RevisionNumberLow | Self::RevisionNumberHigh => AddressPart::RevisionNumber,
            Self::SerialNumberLow | Self::SerialNumberHigh => AddressPart::SerialNumber,
        }
    }

    /// The key after this one; the vendor-ID after the last.
    pub(super) fn next(self) -> Self {
        Self::new(self as u8 + 1).unwrap_or(Self::VendorId)
    }
}

/// One step of Fastscan, as in the frame; all combinations are accepted here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FastscanStep {
    /// The number for the slaves to compare with theirs.
    pub id_number: u32,
    /// The lowest bit of the comparison, 0..=31; 80h begins a new scan.
    pub bit_check: u8,
    /// LSSSub: the part to compare, 0..=3.
    pub sub: u8,
    /// LSSNext: the part that a matching slave expects next, 0..=3.
    pub next: u8,
}

/// An answer of a slave.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Response {
    /// 44: this slave was selected.
    Selected,
    /// 4F: a slave matches identify remote slave or a Fastscan step.
    Identified,
    /// 50: a slave has no node-ID.
    NonConfigured,
    /// 11: error code 0 if accepted, else 1 (out of range).
    ConfigureNodeId {
        /// Whether the node-ID is now pending.
        accepted: bool,
    },
    /// 13: error code 0 if accepted, else 1 (not supported).
    ConfigureBitTiming {
        /// Whether the bit rate is now pending.
        accepted: bool,
    },
    /// 17: error code 0, or the [`StoreError`].
    StoreConfiguration(Result<(), StoreError>),
    /// 5A..5D: a part of the LSS address.
    Inquire(AddressPart, u32),
    /// 5E: the active node-ID.
    InquireNodeId(Option<NodeId>),
}

/// The reason why nothing was stored, with the error codes of store configuration (CiA 305).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum StoreError {
    /// 1: this device cannot store. An SDO client gets abort code 0606 0000h.
    NotSupported,
    /// 2: the medium failed; the previous content is still stored. An SDO client gets abort code 0606 0000h.
    MediumAccess,
    /// 2: the medium is full until the next start; the previous content is still stored. An SDO client gets abort code
    /// 0800 0022h.
    Full,
}

impl StoreError {
    const fn code(self) -> u32 {
        match self {
            Self::NotSupported => 1,
            Self::MediumAccess | Self::Full => 2,
        }
    }
}

impl fmt::Display for StoreError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::NotSupported => "the device cannot store",
            Self::MediumAccess => "the storage medium failed",
            Self::Full => "the storage medium is full until the next start",
        })
    }
}

impl error::Error for StoreError {}

impl From<settings::Error> for StoreError {
    fn from(error: settings::Error) -> Self {
        match error {
            settings::Error::Full => Self::Full,
            _ => Self::MediumAccess,
        }
    }
}

const SWITCH_GLOBAL: u8 = 0x04;
const CONFIGURE_NODE_ID: u8 = 0x11;
const CONFIGURE_BIT_TIMING: u8 = 0x13;
const ACTIVATE_BIT_TIMING: u8 = 0x15;
const STORE_CONFIGURATION: u8 = 0x17;
const SELECT: u8 = 0x40;
const SELECTED: u8 = 0x44;
const IDENTIFY: u8 = 0x46;
const IDENTIFY_NON_CONFIGURED: u8 = 0x4C;
const IDENTIFIED: u8 = 0x4F;
const NON_CONFIGURED: u8 = 0x50;
const FASTSCAN: u8 = 0x51;
const INQUIRE: u8 = 0x5A;
const INQUIRE_NODE_ID: u8 = 0x5E;

impl Request {
    /// The request in the data of a frame; `None` if the command specifier is unknown or that of a response, or if the
    /// mode of a 04 is neither 0 nor 1. Reserved bytes are ignored.
    #[expect(clippy::manual_range_patterns, reason = "a range is not looked up in the jump table")]
    pub fn from_bytes(bytes: &[u8; 8]) -> Option<Self> {
        let [command, b1, b2, b3, b4, b5, b6, b7] = *bytes;
        let number = u32::from_le_bytes([b1, b2, b3, b4]);
        Some(match command {
            SWITCH_GLOBAL if b1 == 0 => Self::SwitchToWaiting,
            SWITCH_GLOBAL if b1 == 1 => Self::SwitchToConfiguration,
            CONFIGURE_NODE_ID => Self::ConfigureNodeId(b1),
            CONFIGURE_BIT_TIMING => Self::ConfigureBitTiming { table: b1, index: b2 },
            ACTIVATE_BIT_TIMING => Self::ActivateBitTiming(u16::from_le_bytes([b1, b2])),
            STORE_CONFIGURATION => Self::StoreConfiguration,
            0x40 | 0x41 | 0x42 | 0x43 => Self::Select(AddressPart::new(command - SELECT)?, number),
            0x46 | 0x47 | 0x48 | 0x49 | 0x4A | 0x4B => {
                Self::Identify(IdentifyKey::new(command - IDENTIFY)?, number)
            }
            IDENTIFY_NON_CONFIGURED => Self::IdentifyNonConfigured,
            FASTSCAN => {
                Self::Fastscan(FastscanStep { id_number: number, bit_check: b5, sub: b6, next: b7 })
            }
            0x5A | 0x5B | 0x5C | 0x5D => Self::Inquire(AddressPart::new(command - INQUIRE)?),
            INQUIRE_NODE_ID => Self::InquireNodeId,
            _ => return None,
        })
    }

    /// The data of the request's frame; reserved bytes are 0.
    pub const fn to_bytes(self) -> [u8; 8] {
        match self {
            Self::SwitchToWaiting => bytes(SWITCH_GLOBAL, 0),
            Self::SwitchToConfiguration => bytes(SWITCH_GLOBAL, 1),
            Self::ConfigureNodeId(id) => bytes(CONFIGURE_NODE_ID, id as u32),
            Self::ConfigureBitTiming { table, index } => {
                bytes(CONFIGURE_BIT_TIMING, u32::from_le_bytes([table, index, 0, 0]))
            }
            Self::ActivateBitTiming(delay_ms) => bytes(ACTIVATE_BIT_TIMING, delay_ms as u32),
            Self::StoreConfiguration => bytes(STORE_CONFIGURATION, 0),
            Self::Select(part, number) => bytes(SELECT + part as u8, number),
            Self::Identify(key, number) => bytes(IDENTIFY + key as u8, number),
            Self::IdentifyNonConfigured => bytes(IDENTIFY_NON_CONFIGURED, 0),
            Self::Fastscan(FastscanStep { id_number, bit_check, sub, next }) => {
                let [command, b1, b2, b3, b4, ..] = bytes(FASTSCAN, id_number);
                [command, b1, b2, b3, b4, bit_check, sub, next]
            }
            Self::Inquire(part) => bytes(INQUIRE + part as u8, 0),
            Self::InquireNodeId => bytes(INQUIRE_NODE_ID, 0),
        }
    }

    /// The request's frame.
    pub const fn to_frame(self) -> Frame {
        Frame::with_eight_bytes(REQUEST_COB_ID, self.to_bytes())
    }
}

impl Response {
    /// The data of the answer's frame. Reserved bytes are 0, so that slaves that answer simultaneously send identical
    /// frames.
    #[inline(always)] // A separate call would pass its answer through memory, byte by byte.
    pub const fn to_bytes(self) -> [u8; 8] {
        let (command, number) = match self {
            Self::Selected => (SELECTED, 0),
            Self::Identified => (IDENTIFIED, 0),
            Self::NonConfigured => (NON_CONFIGURED, 0),
            Self::ConfigureNodeId { accepted } => (CONFIGURE_NODE_ID, !accepted as u32),
            Self::ConfigureBitTiming { accepted } => (CONFIGURE_BIT_TIMING, !accepted as u32),
            Self::StoreConfiguration(Ok(())) => (STORE_CONFIGURATION, 0),
            Self::StoreConfiguration(Err(error)) => (STORE_CONFIGURATION, error.code()),
            Self::Inquire(part, number) => (INQUIRE + part as u8, number),
            Self::InquireNodeId(id) => (INQUIRE_NODE_ID, NodeId::to_lss(id) as u32),
        };
        bytes(command, number)
    }

    /// The answer's frame.
    #[inline(always)] // Apart it takes 196 bytes more.
    pub const fn to_frame(self) -> Frame {
        Frame::with_eight_bytes(RESPONSE_COB_ID, self.to_bytes())
    }
}

const fn bytes(command: u8, number: u32) -> [u8; 8] {
    (command as u64 | (number as u64) << 8).to_le_bytes()
}
