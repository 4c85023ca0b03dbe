//! Emergency messages (CiA 301, 7.2.7): the errors of the node, of process data and of the application, in one queue, and
//! the error history 1003h.

mod configuration;
pub(crate) mod own;

use core::{mem, ops::Range};

use crate::{BitRate, Frame, Instant, NodeId};
pub(crate) use configuration::Configuration;

pub use lss_slave::cob_id::EMERGENCY as COB_ID;
pub use own::OwnCode;

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
    /// 6100h, or 5000h if the crystal was the cause: the firmware has failed, and the device was reset before this start.
    /// Bytes 3..=7 are the [cause](RestartCause) and the address of the [`Restart`]. The fault is over when it is
    /// reported. Report it after the start, once, and not after power-on, a command or a debugger's reset.
    Restarted(Restart),
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

/// Why the device was reset before this start. Object 2000h keeps it, sub-indices 8 and 9.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Restart {
    /// What has failed.
    pub cause: RestartCause,
    /// Where: as the [cause](RestartCause) says.
    pub address: u32,
}

/// What has failed before a [`Restart`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
pub enum RestartCause {
    /// The instruction at the address.
    Fault = 1,
    /// The program has panicked, in the line that the address is.
    Panic = 2,
    /// The stack was too small below the call before the address.
    StackOverflow = 3,
    /// The watchdog has missed tasks; the address has a bit for each.
    Watchdog = 4,
    /// The crystal has stopped.
    CrystalStopped = 5,
    /// The crystal has not started.
    NoCrystal = 6,
    /// The crystal is another one; the address is its frequency in kHz.
    WrongCrystal = 7,
    /// The clock was not that of the crystal; the address is the register of the PLL.
    OtherClock = 8,
}

impl RestartCause {
    /// The cause with this number.
    pub const fn from_number(number: u32) -> Option<Self> {
        Some(match number {
            1 => Self::Fault,
            2 => Self::Panic,
            3 => Self::StackOverflow,
            4 => Self::Watchdog,
            5 => Self::CrystalStopped,
            6 => Self::NoCrystal,
            7 => Self::WrongCrystal,
            8 => Self::OtherClock,
            _ => return None,
        })
    }
}

/// Bit 0 of the error register 1001h: there is an error.
const GENERIC: u8 = 1 << 0;
/// Bit 4 of the error register 1001h: an error of communication.
pub(crate) const COMMUNICATION: u8 = 1 << 4;

// The queue has a place for each error, and messages leave in this order.
/// The places of process data and of the heartbeat consumer, as many as they have error codes.
pub(crate) const PROCESS_DATA: Range<usize> = 0..5;
/// The places of the application.
pub(crate) const APPLICATION: Range<usize> = 5..13;
const SETTINGS_LOST: usize = 13;
const ERROR_PASSIVE: usize = 14;
const BUS_OFF_RECOVERED: usize = 15;
const OVERRUN: usize = 16;
const AWAY_FROM_HOME_RATE: usize = 17;
const RESTARTED: usize = 18;
/// The place of the message with error code 0.
const END: usize = 19;
const PLACES: usize = 20;

/// The content of a message.
#[derive(Clone, Copy, Debug)]
struct EmergencyMessage {
    code: u16,
    /// The bits of the error register 1001h for this error.
    register: u8,
    information: [u8; 5],
}

impl EmergencyMessage {
    /// The one with error code 0.
    const NONE: Self = Self { code: 0, register: 0, information: [0; 5] };

    /// The entry of the history 1003h; 0 without an error.
    fn entry(&self) -> u32 {
        let [i0, i1, ..] = self.information;
        let information = u32::from(i0) << 16 | u32::from(i1) << 24;
        if self.code == 0 { 0 } else { u32::from(self.code) | information }
    }
}

/// The messages that the NMT state allows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Allowed {
    /// None.
    None,
    /// Those that tell why an error of communication has stopped the node.
    Cause,
    /// All.
    All,
}

/// A set of places, a bit for each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Places(u32);

impl Places {
    const NONE: Self = Self(0);
    const ALL: Self = Self(u32::MAX);
    /// The causes of the error behaviour 1029h: a heartbeat that is missing, and bus-off.
    const CAUSES: Self = Self((1 << PROCESS_DATA.end) - 1).and(Self::of(BUS_OFF_RECOVERED));

    const fn of(at: usize) -> Self {
        Self(1_u32.wrapping_shl(at as u32))
    }

    const fn and(self, others: Self) -> Self {
        Self(self.0 | others.0)
    }

    const fn without(self, others: Self) -> Self {
        Self(self.0 & !others.0)
    }

    const fn has(self, at: usize) -> bool {
        self.0 & Self::of(at).0 != 0
    }
}

impl Fault {
    const fn place(self) -> usize {
        match self {
            Self::SettingsLost => SETTINGS_LOST,
            Self::ErrorPassive => ERROR_PASSIVE,
            Self::BusOffRecovered => BUS_OFF_RECOVERED,
            Self::Overrun => OVERRUN,
            Self::Restarted(_) => RESTARTED,
            Self::AwayFromHomeRate { .. } => AWAY_FROM_HOME_RATE,
        }
    }

    /// Whether the fault lasts until its end is reported. The others are over when they are reported.
    const fn lasts(self) -> bool {
        !matches!(self, Self::BusOffRecovered | Self::Overrun | Self::Restarted(_))
    }

    fn message(self) -> EmergencyMessage {
        let mut information = [0; 5];
        let OwnCode { code, register, .. } = match self {
            Self::SettingsLost => own::SETTINGS_LOST,
            Self::ErrorPassive => own::ERROR_PASSIVE,
            Self::BusOffRecovered => own::BUS_OFF_RECOVERED,
            Self::Overrun => own::OVERRUN,
            Self::Restarted(Restart { cause, address }) => {
                let [a0, a1, a2, a3] = address.to_le_bytes();
                information = [cause as u8, a0, a1, a2, a3];
                let is_clock = cause as u8 >= RestartCause::CrystalStopped as u8;
                if is_clock { own::CLOCK } else { own::RESTARTED }
            }
            Self::AwayFromHomeRate { in_use, home } => {
                let [u0, u1] = in_use.kbit_per_s().to_le_bytes();
                let [h0, h1] = home.kbit_per_s().to_le_bytes();
                information = [u0, u1, h0, h1, 0];
                own::AWAY_FROM_HOME_RATE
            }
        };
        EmergencyMessage { code, register, information }
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

/// The errors that are present, the messages about them, and the history.
#[derive(Clone, Debug)]
pub(crate) struct Emergency {
    messages: [EmergencyMessage; PLACES],
    /// The errors that are present.
    present: Places,
    /// The messages that have not been sent.
    unsent: Places,
    /// The message that was sent, while no frame of the node has been acknowledged since. The next one waits: on a bus
    /// that fails again and again they would take the places of answers.
    in_flight: Places,
    /// Its entry of the history.
    entry: u32,
    pub configuration: Configuration,
    /// The end of the inhibit time.
    inhibited_until: Option<Instant>,
    /// 1003h, newest first; 0 marks a free entry.
    history: [u32; HISTORY_LEN as usize],
    bus_offs: u16,
    overruns: u16,
    error_counters: ErrorCounters,
    restart: Option<Restart>,
}

impl Emergency {
    pub const fn new() -> Self {
        Self {
            messages: [EmergencyMessage::NONE; PLACES],
            present: Places::NONE,
            unsent: Places::NONE,
            in_flight: Places::NONE,
            entry: 0,
            configuration: Configuration::DEFAULT,
            inhibited_until: None,
            history: [0; HISTORY_LEN as usize],
            bus_offs: 0,
            overruns: 0,
            error_counters: ErrorCounters { transmit: 0, receive: 0 },
            restart: None,
        }
    }

    /// Restarts the messages with these parameters. The errors stay.
    pub const fn configure(&mut self, configuration: Configuration) {
        self.configuration = configuration;
        self.inhibited_until = None;
    }

    /// Reports a fault of the node.
    pub fn report_fault(&mut self, fault: Fault) {
        match fault {
            Fault::BusOffRecovered => self.bus_offs = self.bus_offs.saturating_add(1),
            Fault::Overrun => self.overruns = self.overruns.saturating_add(1),
            Fault::Restarted(restart) => self.restart = Some(restart),
            _ => {}
        }
        self.put(fault.place(), fault.message());
        if !fault.lasts() {
            self.end_at(fault.place());
        }
    }

    /// Ends a lasting fault; does nothing if the fault is not present.
    pub fn end_fault(&mut self, fault: Fault) {
        self.end_at(fault.place());
    }

    /// Reports an error of process data or of the application, with bits of the error register and the manufacturer's
    /// bytes; returns whether there was room for it among these places.
    pub fn report(
        &mut self,
        places: Range<usize>,
        code: u16,
        register: u8,
        information: [u8; 5],
    ) -> bool {
        let at = self.place_of(places.clone(), code);
        let at = at.or_else(|| self.place_of(places, EmergencyMessage::NONE.code));
        if let Some(at) = at {
            self.put(at, EmergencyMessage { code, register: register | GENERIC, information });
        }
        at.is_some()
    }

    /// Ends an error that [`report`](Self::report) has put among these places; does nothing if it is not present.
    pub fn end(&mut self, places: Range<usize>, code: u16) {
        if let Some(at) = self.place_of(places, code) {
            self.end_at(at);
        }
    }

    /// Whether there are errors of process data or of the heartbeat consumer, or messages about them.
    pub const fn has_process_data_errors(&self) -> bool {
        const EACH: u32 = (1 << PROCESS_DATA.end) - 1;
        self.used().0 & EACH != 0
    }

    /// The places that an error or an unacknowledged message takes.
    const fn used(&self) -> Places {
        self.present.and(self.unsent).and(self.in_flight)
    }

    /// The place among these with this error code; 0 is that of a free one.
    fn place_of(&self, mut places: Range<usize>, code: u16) -> Option<usize> {
        places.find(|at| self.messages.get(*at).is_some_and(|message| message.code == code))
    }

    /// Makes an error present, and its message due.
    fn put(&mut self, at: usize, message: EmergencyMessage) {
        if let Some(place) = self.messages.get_mut(at) {
            *place = message;
        }
        self.present = self.present.and(Places::of(at));
        self.unsent = self.unsent.and(Places::of(at));
    }

    fn end_at(&mut self, at: usize) {
        if !self.present.has(at) {
            return;
        }
        self.present = self.present.without(Places::of(at));
        if self.present == Places::NONE {
            let is_return_home = at == AWAY_FROM_HOME_RATE;
            let ended = if is_return_home { self.messages[at] } else { EmergencyMessage::NONE };
            self.messages[END].information = ended.information;
            self.unsent = self.unsent.and(Places::of(END));
        }
        self.clear_unused(at);
    }

    /// Clears a place that no error takes any more.
    fn clear_unused(&mut self, at: usize) {
        let is_used = self.used().has(at);
        if let Some(place) = self.messages.get_mut(at).filter(|_| !is_used) {
            *place = EmergencyMessage::NONE;
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
            self.end_fault(Fault::ErrorPassive);
        } else if is_passive && !self.present.has(ERROR_PASSIVE) && !is_listening {
            self.report_fault(Fault::ErrorPassive);
        }
    }

    /// The controller's latest error counters.
    pub const fn error_counters(&self) -> ErrorCounters {
        self.error_counters
    }

    /// The number of [`Fault::BusOffRecovered`] reports.
    pub const fn bus_offs(&self) -> u16 {
        self.bus_offs
    }

    /// The number of [`Fault::Overrun`] reports.
    pub const fn overruns(&self) -> u16 {
        self.overruns
    }

    /// The latest [`Fault::Restarted`].
    pub const fn restart(&self) -> Option<Restart> {
        self.restart
    }

    /// The error register 1001h.
    pub fn error_register(&self) -> u8 {
        let present = self.messages.iter().enumerate().filter(|(at, _)| self.present.has(*at));
        present.fold(0, |register, (_, message)| register | message.register)
    }

    /// Sub-index 1..=8 of the history 1003h: the error code, and the first two bytes of the information in the upper
    /// half.
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

    /// Whether an acknowledge makes a difference.
    pub const fn awaits_acknowledge(&self) -> bool {
        self.in_flight.0 != 0
    }

    /// Records that a frame of the node was acknowledged. Emergency messages are sent before all periodic frames. The
    /// history 1003h takes those that have left.
    pub fn note_acknowledge(&mut self) {
        let mut newer = mem::take(&mut self.entry);
        if newer != 0 {
            self.history.iter_mut().for_each(|place| mem::swap(place, &mut newer));
        }
        let acknowledged = self.in_flight.0.trailing_zeros() as usize;
        self.in_flight = Places::NONE;
        self.clear_unused(acknowledged);
    }

    /// Records that the pending frames were dropped: a message that was not acknowledged is sent again.
    pub const fn frames_dropped(&mut self) {
        self.unsent = self.unsent.and(self.in_flight);
        (self.in_flight, self.entry) = (Places::NONE, 0);
    }

    /// Ends the inhibit time, if it is over.
    pub fn end_inhibit_time(&mut self, now: Instant) {
        let micros = u32::from(self.configuration.inhibit_time) * 100;
        self.inhibited_until.take_if(|until| !until.is_ahead(now, micros));
    }

    /// The end of the inhibit time.
    pub const fn inhibited_until(&self) -> Option<Instant> {
        self.inhibited_until
    }

    /// The next message, if there is one to send. While the node hears nothing but errors it sends none: a message
    /// would disturb nodes that may run at another bit rate. Without a COB-ID the messages only enter the history.
    ///
    /// Error code 0 is sent when no error is left. CiA 301 allows it at the end of each error, but some masters take it
    /// for the end of all. A guest reports only that it is one.
    pub fn next(
        &mut self,
        node: NodeId,
        is_guest: bool,
        allowed: Allowed,
        now: Instant,
    ) -> Option<Frame> {
        if self.awaits_acknowledge() || allowed == Allowed::None {
            return None;
        }
        let Some(cob_id) = self.configuration.cob_id(node) else {
            while self.take(Places::ALL).is_some() {
                self.note_acknowledge();
            }
            return None;
        };
        if self.inhibited_until.is_some() || self.error_counters.receive >= ERROR_PASSIVE_LIMIT {
            return None;
        }
        let among = match (allowed, is_guest) {
            (_, true) => Places::of(AWAY_FROM_HOME_RATE),
            (Allowed::Cause, _) => Places::CAUSES,
            _ => Places::ALL,
        };
        let EmergencyMessage { code, register, information } = self.take(among)?;
        let inhibit_time = self.configuration.inhibit_time;
        self.inhibited_until =
            (inhibit_time > 0).then(|| now.plus_micros(u32::from(inhibit_time) * 100));
        let [c0, c1] = code.to_le_bytes();
        let [i0, i1, i2, i3, i4] = information;
        let data = [c0, c1, register | self.error_register(), i0, i1, i2, i3, i4];
        Some(Frame::with_eight_bytes(cob_id, data))
    }

    /// Takes the first message in one of these places out of the queue, if there is one;
    /// [`note_acknowledge`](Self::note_acknowledge) completes it.
    fn take(&mut self, among: Places) -> Option<EmergencyMessage> {
        if self.present != Places::NONE {
            self.unsent = self.unsent.without(Places::of(END));
        }
        let at = (self.unsent.0 & among.0).trailing_zeros() as usize;
        let message = *self.messages.get(at)?;
        self.unsent = self.unsent.without(Places::of(at));
        self.in_flight = Places::of(at);
        self.entry = message.entry();
        Some(message)
    }
}
