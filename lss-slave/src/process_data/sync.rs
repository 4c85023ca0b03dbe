//! The SYNC consumer (CiA 301, 7.2.5): 1005h and 1019h.

use super::cob_id::is_restricted;
use crate::{Frame, sdo::Abort};

/// Error code of a SYNC whose length does not fit 1019h (CiA 301, table 26).
pub(super) const WRONG_LENGTH: u16 = 0x8240;

/// The COB-ID of SYNC in the predefined connection set (CiA 301).
pub const COB_ID: u16 = 0x080;

/// The parameters of the SYNC consumer.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sync {
    cob_id: u16,
    /// 1019h: 0, or the highest counter.
    overflow: u8,
}

/// A SYNC with a wrong length, which is ignored.
pub(super) struct WrongLength;

impl Sync {
    pub const fn new() -> Self {
        Self { cob_id: COB_ID, overflow: 0 }
    }

    pub const fn cob_id(&self) -> u16 {
        self.cob_id
    }

    pub const fn overflow(&self) -> u8 {
        self.overflow
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

    /// Sets 1005h.
    ///
    /// # Errors
    /// [`Abort::InvalidValue`] for a producer (bit 30), a 29-bit identifier or a restricted CAN-ID.
    pub fn set_cob_id(&mut self, value: u32) -> Result<(), Abort> {
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
    /// [`Abort::InvalidValue`] unless it is 0 or 2 to 240.
    pub fn set_overflow(&mut self, overflow: u8) -> Result<(), Abort> {
        if !matches!(overflow, 0 | 2..=240) {
            return Err(Abort::InvalidValue);
        }
        self.overflow = overflow;
        Ok(())
    }
}
