//! The CAN frame of CANopen: an 11-bit identifier and up to eight bytes of data.

use core::fmt;

use embedded_can::{Id, StandardId};

use crate::BitRate;

/// A classical CAN data frame with an 11-bit identifier.
///
/// It cannot hold remote frames, 29-bit identifiers and data length codes above 8. CANopen gives them no meaning for
/// this node, and [`Frame::received`] drops them.
#[derive(Clone, Copy)]
#[repr(align(4))]
pub struct Frame {
    /// The data is the first `len` bytes.
    data: [u8; 8],
    cob_id: u16,
    len: u8,
}

impl Frame {
    /// A frame with the COB-ID `cob_id` (0..=7FFh) and 0..=8 bytes of data; `None` outside these ranges.
    pub fn new(cob_id: u16, data: &[u8]) -> Option<Self> {
        let mut padded = [0; 8];
        padded.get_mut(..data.len())?.copy_from_slice(data);
        Self::from_padded(cob_id, data.len(), padded)
    }

    /// A frame as a controller holds it: its COB-ID (0..=7FFh), its data length (0..=8), and eight bytes that begin
    /// with the data. `None` outside these ranges.
    pub const fn from_padded(cob_id: u16, len: usize, data: [u8; 8]) -> Option<Self> {
        if cob_id > 0x7FF || len > 8 {
            return None;
        }
        Some(Self { data, cob_id, len: len as u8 })
    }

    /// The frame that a CAN driver received, unless it is a remote frame or has a 29-bit identifier.
    pub fn received(frame: &impl embedded_can::Frame) -> Option<Self> {
        match frame.id() {
            Id::Standard(id) if !frame.is_remote_frame() => Self::new(id.as_raw(), frame.data()),
            _ => None,
        }
    }

    /// A frame with eight bytes. The COB-ID must be 0..=7FFh.
    #[doc(hidden)]
    pub const fn with_eight_bytes(cob_id: u16, data: [u8; 8]) -> Self {
        Self { data, cob_id, len: 8 }
    }

    /// A frame with the first `len` of these bytes, 0..=8. The COB-ID must be 0..=7FFh.
    #[doc(hidden)]
    pub const fn with_bytes(cob_id: u16, len: usize, data: [u8; 8]) -> Self {
        Self { data, cob_id, len: len as u8 }
    }

    /// A frame with one byte. The COB-ID must be 0..=7FFh.
    #[doc(hidden)]
    pub const fn with_one_byte(cob_id: u16, byte: u8) -> Self {
        Self { data: [byte, 0, 0, 0, 0, 0, 0, 0], cob_id, len: 1 }
    }

    /// The COB-ID, which is the 11-bit CAN identifier: 0..=7FFh.
    pub const fn cob_id(&self) -> u16 {
        self.cob_id
    }

    /// The data: 0..=8 bytes.
    pub fn data(&self) -> &[u8] {
        self.data.get(..usize::from(self.len)).unwrap_or(&self.data)
    }

    /// Eight bytes that begin with the data, for a controller that takes all eight; the rest has no meaning.
    pub const fn padded_data(&self) -> [u8; 8] {
        self.data
    }

    /// The longest time that the frame takes on a bus at `rate`, in microseconds: with the most stuff bits, and the
    /// three bits that follow it (ISO 11898-1).
    #[doc(hidden)]
    pub const fn longest_micros(&self, rate: BitRate) -> u32 {
        let stuffed = 34 + 8 * self.len as u32;
        let bits = stuffed + (stuffed - 1) / 4 + 13;
        (bits * 1000).div_ceil(rate.kbit_per_s() as u32)
    }

    /// The data of a frame that has all eight bytes, as every LSS and SDO frame does.
    #[doc(hidden)]
    #[inline]
    pub fn eight_bytes(&self) -> Option<&[u8; 8]> {
        (self.len == 8).then_some(&self.data)
    }
}

impl embedded_can::Frame for Frame {
    fn new(id: impl Into<Id>, data: &[u8]) -> Option<Self> {
        match id.into() {
            Id::Standard(id) => Self::new(id.as_raw(), data),
            Id::Extended(_) => None,
        }
    }

    /// Returns `None`: this type holds no remote frames.
    fn new_remote(_: impl Into<Id>, _: usize) -> Option<Self> {
        None
    }

    fn is_extended(&self) -> bool {
        false
    }

    fn is_remote_frame(&self) -> bool {
        false
    }

    fn id(&self) -> Id {
        StandardId::new(self.cob_id).unwrap_or(StandardId::MAX).into()
    }

    fn dlc(&self) -> usize {
        self.len.into()
    }

    fn data(&self) -> &[u8] {
        self.data()
    }
}

#[cfg(feature = "defmt")]
impl defmt::Format for Frame {
    fn format(&self, f: defmt::Formatter<'_>) {
        defmt::write!(f, "{=u16:03x}: {=[u8]:02x}", self.cob_id, self.data());
    }
}

impl PartialEq for Frame {
    fn eq(&self, other: &Self) -> bool {
        (self.cob_id, self.data()) == (other.cob_id, other.data())
    }
}

impl Eq for Frame {}

impl fmt::Debug for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:03X}: {:02X?}", self.cob_id, self.data())
    }
}
