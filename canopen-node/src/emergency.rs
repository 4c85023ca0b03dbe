//! Emergency messages (CiA 301, 7.2.7): the faults that the node reports and its error history 1003h.

mod faults;
mod reports;

use crate::{BitRate, Frame, NodeId};
pub(crate) use faults::{ErrorCounters, Faults};
#[doc(hidden)]
pub use reports::{Places, Report};
pub(crate) use reports::{Reporter, Reports};

pub use lss_slave::cob_id::EMERGENCY as COB_ID;

/// The number of errors that the history 1003h keeps.
pub(crate) const HISTORY_LEN: u8 = 8;

/// A fault that an emergency message reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum Fault {
    /// 6310h: the stored settings were damaged and the defaults are in use. The fault lasts until settings are stored.
    SettingsLost,
    /// 8120h: the controller is error passive (ISO 11898-1). The node detects the fault and its end in
    /// [`BusEvent::ErrorCounters`](crate::BusEvent::ErrorCounters).
    ErrorPassive,
    /// 8140h: the controller has recovered from bus-off, as reported by
    /// [`BusEvent::BusOffRecovered`](crate::BusEvent::BusOffRecovered).
    BusOffRecovered,
    /// 8110h: the controller received frames faster than they were read, as reported by
    /// [`BusEvent::Overrun`](crate::BusEvent::Overrun).
    Overrun,
    /// FF10h: the node takes part in the bus at a bit rate other than its home rate. Bytes 3..=6 of the message, and of
    /// the message for its end, are the two rates in kbit/s, 16 bits each, little endian. The node detects both by
    /// itself.
    AwayFromHomeRate {
        /// The controller's current bit rate.
        in_use: BitRate,
        /// The bit rate that was last commanded.
        home: BitRate,
    },
}

/// Bit 0 of the error register 1001h: there is an error.
const GENERIC: u8 = 1 << 0;
/// Bit 4 of the error register 1001h: an error of communication.
pub(crate) const COMMUNICATION: u8 = 1 << 4;

/// The errors of the node: its own faults, and the reports of its application and process data.
#[derive(Clone, Debug)]
pub(crate) struct Emergency<L> {
    pub faults: Faults,
    reports: Reports<L>,
    /// A message was sent, and no frame of the node has been acknowledged since. The next one waits: on a bus that
    /// fails again and again they would take the places of answers.
    is_in_flight: bool,
}

impl<L: Places> Emergency<L> {
    pub const fn new() -> Self {
        Self { faults: Faults::new(), reports: Reports::new(), is_in_flight: false }
    }

    /// The reports, to be added to and ended.
    pub fn reporter(&mut self) -> Reporter<'_> {
        self.reports.reporter(&mut self.faults)
    }

    /// The error register 1001h.
    pub fn error_register(&self) -> u8 {
        self.faults.error_register() | self.reports.error_register()
    }

    /// Whether an acknowledge may make a difference.
    pub fn awaits_acknowledge(&self) -> bool {
        self.is_in_flight || !self.reports.is_empty()
    }

    /// Records that a frame of the node was acknowledged. Emergency messages are sent before all periodic frames.
    pub fn note_acknowledge(&mut self) {
        self.is_in_flight = false;
        self.faults.note_acknowledge();
        self.reports.note_acknowledge();
    }

    /// Records that the pending frames were dropped: messages that were not acknowledged are sent again.
    pub fn note_dropped(&mut self) {
        self.is_in_flight = false;
        self.faults.note_dropped();
        self.reports.note_dropped();
    }

    /// The next message, if there is one to send. While the node hears nothing but errors it sends none: a message
    /// would disturb nodes that may run at another bit rate.
    pub fn next(&mut self, node: NodeId) -> Option<Frame> {
        if self.is_in_flight || self.faults.must_wait() {
            return None;
        }
        let report = self.reports.next(node, self.faults.error_register());
        let message = report.or_else(|| self.faults.next(node, self.reports.error_register()));
        self.is_in_flight = message.is_some();
        message
    }
}
