//! The reception of an RPDO: the effect of its frames.

use super::Pdo;
use crate::{Application, Frame, Instant, emergency::own};

pub(super) const TOO_SHORT: u16 = own::PDO_TOO_SHORT.code;
pub(super) const TOO_LONG: u16 = own::PDO_TOO_LONG.code;
pub(super) const LATE: u16 = own::PDO_LATE.code;

/// The state of an RPDO in NMT operational.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reception {
    /// `None`: it is not in use.
    cob_id: Option<u16>,
    /// The error code for the length of the latest frame, or for the lack of the next one.
    fault: Option<u16>,
    /// The data that waits for the next SYNC.
    waiting: Option<[u8; 8]>,
    /// The end of the event timer.
    deadline: Option<Instant>,
}

impl Reception {
    /// An RPDO that is not in use.
    pub const UNUSED: Self = Self { cob_id: None, fault: None, waiting: None, deadline: None };

    /// An RPDO of which nothing was received. Without a COB-ID it is not in use.
    pub const fn new(cob_id: Option<u16>) -> Self {
        Self { cob_id, ..Self::UNUSED }
    }

    /// Whether frames of this COB-ID are for the RPDO.
    pub fn receives(&self, cob_id: u16) -> bool {
        self.cob_id == Some(cob_id)
    }

    /// The error code for the length of the latest frame, or for the lack of the next one.
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

    /// Takes the data of a frame whose length was checked; returns whether it has taken effect. Synchronous data behind the
    /// synchronous window is dropped.
    pub fn handle<A: Application>(
        &mut self,
        pdo: &Pdo,
        frame: &Frame,
        application: &mut A,
        is_window_over: bool,
        now: Instant,
    ) -> bool {
        if pdo.mapping.is_empty() || self.fault == Some(TOO_SHORT) {
            return false;
        }
        let micros = pdo.event_timer_micros();
        self.deadline = (micros > 0).then(|| now.plus_micros(micros));
        // Types 0 to 240 are synchronous: the data takes effect at the next SYNC.
        if pdo.transmission_type <= 240 {
            if !is_window_over {
                self.waiting = Some(frame.padded_data());
            }
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

    /// Whether the next frame begins to be missing at `now`.
    pub fn poll(&mut self, now: Instant) -> bool {
        let is_late = self.deadline.take_if(|deadline| deadline.has_come(now)).is_some();
        if is_late {
            // It ends with the next frame, whose length replaces it.
            self.fault = Some(LATE);
        }
        is_late
    }

    /// The end of the event timer.
    pub const fn deadline(&self) -> Option<Instant> {
        self.deadline
    }

    /// Ends the event timer until the next frame.
    pub const fn end_event_timer(&mut self) {
        self.deadline = None;
    }
}
