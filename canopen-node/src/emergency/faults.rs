//! The faults of the node: those that last, those whose message is due, and the error history 1003h.

use core::mem;

use lss_slave::bit_rate::GUEST_ERROR_CODE;

use super::{COB_ID, COMMUNICATION, Fault, GENERIC, HISTORY_LEN};
use crate::{Frame, NodeId};

// Each fault is a bit. Pending messages are sent in this order.
const SETTINGS_LOST: u8 = 1 << 0;
const ERROR_PASSIVE: u8 = 1 << 1;
const BUS_OFF_RECOVERED: u8 = 1 << 2;
const OVERRUN: u8 = 1 << 3;
const AWAY_FROM_HOME_RATE: u8 = 1 << 4;

/// The bit of the message with error code 0.
const END: u8 = 1 << 7;

/// The faults that last until their end is reported. The others are over when they are reported.
const LASTING: u8 = SETTINGS_LOST | ERROR_PASSIVE | AWAY_FROM_HOME_RATE;

#[inline(never)] // It has several callers: 20 bytes.
const fn error_code(fault: u8) -> u16 {
    match fault {
        SETTINGS_LOST => 0x6310,
        ERROR_PASSIVE => 0x8120,
        BUS_OFF_RECOVERED => 0x8140,
        OVERRUN => 0x8110,
        _ => GUEST_ERROR_CODE,
    }
}

/// The error register 1001h for a set of faults.
const fn error_register(faults: u8) -> u8 {
    match faults {
        0 => 0,
        SETTINGS_LOST => GENERIC,
        _ => GENERIC | COMMUNICATION,
    }
}

impl Fault {
    const fn bit(self) -> u8 {
        match self {
            Self::SettingsLost => SETTINGS_LOST,
            Self::ErrorPassive => ERROR_PASSIVE,
            Self::BusOffRecovered => BUS_OFF_RECOVERED,
            Self::Overrun => OVERRUN,
            Self::AwayFromHomeRate { .. } => AWAY_FROM_HOME_RATE,
        }
    }
}

/// The lowest error counter of an error passive controller (ISO 11898-1).
const ERROR_PASSIVE_LIMIT: u8 = 128;
/// The error warning limit (ISO 11898-1).
const WARNING_LIMIT: u8 = 96;

/// The controller's error counters (ISO 11898-1).
#[derive(Clone, Copy, Debug)]
pub(crate) struct ErrorCounters {
    /// TEC.
    pub transmit: u8,
    /// REC.
    pub receive: u8,
}

/// The unreported faults, the lasting faults and the error history.
#[derive(Clone, Debug)]
pub(crate) struct Faults {
    /// Faults whose message has not been sent.
    unsent: u8,
    /// A fault has ended since the last message with error code 0.
    is_end_unsent: bool,
    /// The messages sent since the latest acknowledge: faults and [`END`].
    in_flight: u8,
    lasting: u8,
    /// Bytes 3..=6 of the messages for [`Fault::AwayFromHomeRate`] and for its end, in kbit/s: the rate in use in the
    /// lower half, the home rate in the upper half.
    rates: u32,
    /// 1003h, newest first; 0 marks a free entry.
    history: [u32; HISTORY_LEN as usize],
    bus_offs: u16,
    overruns: u16,
    error_counters: ErrorCounters,
}

impl Faults {
    pub const fn new() -> Self {
        Self {
            unsent: 0,
            is_end_unsent: false,
            in_flight: 0,
            lasting: 0,
            rates: 0,
            history: [0; HISTORY_LEN as usize],
            bus_offs: 0,
            overruns: 0,
            error_counters: ErrorCounters { transmit: 0, receive: 0 },
        }
    }

    #[inline(never)] // It has several callers.
    pub fn report(&mut self, fault: Fault) {
        let mut information = 0;
        match fault {
            Fault::BusOffRecovered => self.bus_offs = self.bus_offs.saturating_add(1),
            Fault::Overrun => self.overruns = self.overruns.saturating_add(1),
            Fault::AwayFromHomeRate { in_use, home } => {
                information = in_use.kbit_per_s().into();
                self.rates = information | u32::from(home.kbit_per_s()) << 16;
            }
            Fault::SettingsLost | Fault::ErrorPassive => {}
        }
        let bit = fault.bit();
        if bit & LASTING != 0 {
            self.lasting |= bit;
        } else {
            self.is_end_unsent = true;
        }
        // One entry per message.
        if self.unsent & bit == 0 {
            self.unsent |= bit;
            self.enter(u32::from(error_code(bit)) | information << 16);
        }
    }

    /// Records the controller's error counters. A controller that only listens takes no part in the bus and is not
    /// reported.
    pub fn handle_error_counters(&mut self, counters: ErrorCounters, is_listening: bool) {
        let ErrorCounters { transmit, receive } = counters;
        self.error_counters = counters;
        let is_passive = transmit >= ERROR_PASSIVE_LIMIT || receive >= ERROR_PASSIVE_LIMIT;
        // After one valid frame an error passive receiver counts 119..=127, and the next error makes it error passive
        // again. That is not the end of the fault.
        if !is_passive && receive < WARNING_LIMIT {
            self.end(Fault::ErrorPassive);
        } else if is_passive && !self.has(Fault::ErrorPassive) && !is_listening {
            self.report(Fault::ErrorPassive);
        }
    }

    /// The controller's latest error counters.
    pub const fn error_counters(&self) -> ErrorCounters {
        self.error_counters
    }

    /// Ends a lasting fault; does nothing if the fault is not present.
    #[inline(always)] // The fault is a constant: 40 bytes.
    pub const fn end(&mut self, fault: Fault) {
        let bit = fault.bit();
        if self.lasting & bit != 0 {
            self.lasting &= !bit;
            self.is_end_unsent = true;
        }
    }

    const fn has(&self, fault: Fault) -> bool {
        self.lasting & fault.bit() != 0
    }

    /// The number of [`Fault::BusOffRecovered`] reports.
    pub const fn bus_offs(&self) -> u16 {
        self.bus_offs
    }

    /// The number of [`Fault::Overrun`] reports.
    pub const fn overruns(&self) -> u16 {
        self.overruns
    }

    /// The error register 1001h for the faults.
    pub const fn error_register(&self) -> u8 {
        error_register(self.lasting)
    }

    /// Sub-index 1..=8 of the history 1003h: the error code and, for [`Fault::AwayFromHomeRate`], the bit rate in use
    /// in kbit/s in the upper half.
    pub fn error(&self, sub_index: u8) -> Option<u32> {
        let error = self.history.get(usize::from(sub_index.checked_sub(1)?))?;
        (*error != 0).then_some(*error)
    }

    /// Sub-index 0 of the history 1003h.
    pub fn number_of_errors(&self) -> u8 {
        let first_place_free = self.history.iter().position(|error| *error == 0);
        first_place_free.map_or(HISTORY_LEN, |number| number as u8)
    }

    pub const fn clear_history(&mut self) {
        self.history = [0; HISTORY_LEN as usize];
    }

    /// Records that an error has ended, whose message is not in this queue.
    pub const fn note_end(&mut self) {
        self.is_end_unsent = true;
    }

    /// Adds an error to the history 1003h.
    pub fn enter(&mut self, error: u32) {
        let mut newer = error;
        for place in &mut self.history {
            newer = mem::replace(place, newer);
        }
    }

    /// Records that a frame of the node was acknowledged.
    pub const fn note_acknowledge(&mut self) {
        if self.in_flight & END != 0 {
            self.rates = 0;
        }
        self.in_flight = 0;
    }

    /// Records that the pending frames were dropped.
    pub const fn note_dropped(&mut self) {
        self.unsent |= self.in_flight & !END;
        self.is_end_unsent |= self.in_flight & END != 0;
        self.in_flight = 0;
    }

    /// Whether the node hears nothing but errors.
    pub const fn must_wait(&self) -> bool {
        self.error_counters.receive >= ERROR_PASSIVE_LIMIT
    }

    /// The next message, if there is one to send.
    ///
    /// Error code 0 is sent when no fault is left. CiA 301 allows it at the end of each fault, but some masters take it
    /// for the end of all faults.
    ///
    /// `others` is the error register for the reports.
    pub fn next(&mut self, node: NodeId, others: u8) -> Option<Frame> {
        let fault = self.unsent & self.unsent.wrapping_neg();
        self.unsent &= !fault;
        self.in_flight |= fault;
        let (error_code, rates) = match fault {
            0 if mem::take(&mut self.is_end_unsent) && self.lasting == 0 && others == 0 => {
                self.in_flight |= END;
                (0, self.rates)
            }
            0 => return None,
            AWAY_FROM_HOME_RATE => (error_code(fault), self.rates),
            _ => (error_code(fault), 0),
        };
        let register = error_register(fault | self.lasting) | others;
        let data = u64::from(error_code) | u64::from(register) << 16 | u64::from(rates) << 24;
        Some(Frame::with_eight_bytes(COB_ID + u16::from(node.get()), data.to_le_bytes()))
    }
}
