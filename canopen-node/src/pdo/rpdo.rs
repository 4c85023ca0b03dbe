//! The reception of an RPDO: the effect of its frames.

use super::Pdo;
use crate::{Application, Frame};

/// Error code of a PDO that is shorter than its mapping, and ignored (CiA 301, table 26).
pub(super) const TOO_SHORT: u16 = 0x8210;
/// Error code of a PDO that is longer than its mapping; its first bytes are used (CiA 301, table 26).
pub(super) const TOO_LONG: u16 = 0x8220;

/// The state of an RPDO in NMT operational.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reception {
    /// `None`: it is not in use.
    cob_id: Option<u16>,
    /// The error code for the length of the latest frame.
    fault: Option<u16>,
    /// The data that waits for the next SYNC.
    waiting: Option<[u8; 8]>,
}

impl Reception {
    /// An RPDO that is not in use.
    pub const UNUSED: Self = Self { cob_id: None, fault: None, waiting: None };

    /// An RPDO of which nothing was received. Without a COB-ID it is not in use.
    pub const fn new(cob_id: Option<u16>) -> Self {
        Self { cob_id, ..Self::UNUSED }
    }

    /// Whether frames of this COB-ID are for the RPDO.
    pub fn receives(&self, cob_id: u16) -> bool {
        self.cob_id == Some(cob_id)
    }

    /// The error code for the length of the latest frame.
    pub const fn fault(&self) -> Option<u16> {
        self.fault
    }

    /// Compares the length of a frame with the mapping; returns the error code of a new fault.
    pub fn check_length(&mut self, pdo: &Pdo, frame: &Frame) -> Option<u16> {
        let (len, expected) = (frame.data().len(), pdo.mapping.len());
        let fault = match len {
            _ if pdo.mapping.is_empty() || len == expected => None,
            _ if len < expected => Some(TOO_SHORT),
            _ => Some(TOO_LONG),
        };
        let is_new = fault != self.fault;
        self.fault = fault;
        fault.filter(|_| is_new)
    }

    /// Takes the data of a frame whose length was checked; returns whether it has taken effect.
    pub fn handle<A: Application>(
        &mut self,
        pdo: &Pdo,
        frame: &Frame,
        application: &mut A,
    ) -> bool {
        if pdo.mapping.is_empty() || self.fault == Some(TOO_SHORT) {
            return false;
        }
        if pdo.transmission_type <= 240 {
            self.waiting = Some(frame.padded_data());
            return false;
        }
        pdo.mapping.write(&frame.padded_data(), application);
        true
    }

    /// Lets the data that waits take effect; returns whether there was any.
    pub fn handle_sync<A: Application>(&mut self, pdo: &Pdo, application: &mut A) -> bool {
        let Some(data) = self.waiting.take() else {
            return false;
        };
        pdo.mapping.write(&data, application);
        true
    }
}
