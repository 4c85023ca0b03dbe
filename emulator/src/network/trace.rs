//! The record of a network's life: frames, error frames, and what boards did to their CAN
//! controllers.

use std::fmt;

use super::AdapterId;
use crate::{
    Time,
    can::{self, Controller, ErrorKind, Frame, bxcan::Note},
    chip::{Chip, ResetCause},
};

/// Errors that others find within so many bits after the first belong to the same error frame.
const ERROR_FRAME_BITS: u64 = 20;

/// Who made an [`Event`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Source {
    /// The board of this number.
    Board(usize),
    /// An adapter.
    Adapter(AdapterId),
}

impl fmt::Display for Source {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Board(number) => write!(f, "board {number}"),
            Self::Adapter(AdapterId(number)) => write!(f, "adapter {number}"),
        }
    }
}

/// Something that happened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Event {
    /// When; of a frame, the end of its last EOF bit.
    pub time: Time,
    /// Who did it; of a frame the first of its senders, of an error frame who raised it first.
    pub source: Source,
    /// What.
    pub what: What,
}

/// What happened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum What {
    /// A frame passed over the bus.
    Frame {
        /// The frame.
        frame: Frame,
        /// When its SOF began.
        start: Time,
        /// Nominal bit rate of its sender, in bit/s.
        bit_rate: u32,
        /// Others who sent the same frame at the same time.
        also: Vec<Source>,
    },
    /// An error frame began, active or passive.
    Error {
        /// What was found wrong.
        kind: ErrorKind,
        /// Whether it was the transmitter who found it.
        transmitting: bool,
    },
    /// A board asked for a transmission.
    Requested {
        /// Number of the mailbox, 0..=2.
        mailbox: usize,
        /// What is in it.
        frame: Frame,
    },
    /// A board emptied a mailbox whose frame was not under way.
    Aborted {
        /// Number of the mailbox, 0..=2.
        mailbox: usize,
        /// What was in it.
        frame: Frame,
    },
    /// A board changed its bit timing.
    BitTiming {
        /// BTR as written.
        btr: u32,
        /// The nominal bit rate that it stands for, in bit/s.
        bit_rate: u32,
    },
    /// INAK was set.
    InitializationEntered,
    /// INAK was cleared.
    InitializationLeft,
    /// A controller went bus-off.
    BusOff,
    /// A controller finished its bus-off recovery.
    Recovered,
    /// A board was reset.
    Reset(ResetCause),
    /// A board lost its supply.
    PowerOff,
    /// A board got its supply back.
    PowerOn,
}

/// A line of a log: time in milliseconds, who, what.
impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:>14}  {:10}  ", self.time, self.source.to_string())?;
        match &self.what {
            What::Frame { frame, bit_rate, also, .. } => {
                write!(f, "{frame} at {bit_rate} bit/s")?;
                also.iter().try_for_each(|source| write!(f, ", {source}"))
            }
            What::Error { kind, transmitting } => {
                let role = if *transmitting { "transmitting" } else { "receiving" };
                write!(f, "error frame: {kind:?} while {role}")
            }
            What::Requested { mailbox, frame } => write!(f, "mailbox {mailbox} requests {frame}"),
            What::Aborted { mailbox, frame } => write!(f, "mailbox {mailbox} aborts {frame}"),
            What::BitTiming { btr, bit_rate } => write!(f, "BTR {btr:08x}: {bit_rate} bit/s"),
            What::InitializationEntered => write!(f, "initialisation entered"),
            What::InitializationLeft => write!(f, "initialisation left"),
            What::BusOff => write!(f, "bus-off"),
            What::Recovered => write!(f, "recovered from bus-off"),
            What::Reset(cause) => write!(f, "reset: {cause:?}"),
            What::PowerOff => write!(f, "power off"),
            What::PowerOn => write!(f, "power on"),
        }
    }
}

/// How much of a trace is kept.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Recording {
    /// Everything.
    #[default]
    All,
    /// At least this number of latest events, and at most twice as many.
    Latest(usize),
    /// Nothing.
    Off,
}

/// The events so far, in order of time.
#[derive(Default)]
pub(super) struct Trace {
    recording: Recording,
    events: Vec<Event>,
    /// Who raised the latest error frame, and until when errors of others belong to it.
    error_frame: Option<(Source, Time)>,
}

impl Trace {
    pub fn events(&self) -> &[Event] {
        &self.events
    }

    pub fn record(&mut self, recording: Recording) {
        self.recording = recording;
        self.trim();
    }

    /// Adds an event at its place in time: boards run ahead of the bus, so it need not be the last.
    pub fn push(&mut self, time: Time, source: Source, what: What) {
        if self.recording == Recording::Off {
            return;
        }
        let after = self.events.iter().rposition(|event| event.time <= time);
        self.events.insert(after.map_or(0, |index| index + 1), Event { time, source, what });
        self.trim();
    }

    fn trim(&mut self) {
        let keep = match self.recording {
            Recording::All => return,
            Recording::Latest(count) => count,
            Recording::Off => 0,
        };
        if self.events.len() > 2 * keep {
            self.events.drain(..self.events.len() - keep);
        }
    }

    /// Takes what a controller on the wire reports.
    pub fn observe(&mut self, source: Source, controller: &Controller, event: &can::Event) {
        let now = controller.now();
        match *event {
            can::Event::Transmitted { frame, start, end } if !controller.mode().silent => {
                self.frame(source, frame, start, end, controller.bit_rate());
            }
            can::Event::Error { kind, transmitting } if !controller.mode().silent => {
                self.error(now, source, controller.bit_rate(), What::Error { kind, transmitting });
            }
            can::Event::BusOff => self.push(now, source, What::BusOff),
            can::Event::Recovered => self.push(now, source, What::Recovered),
            _ => {}
        }
    }

    fn error(&mut self, now: Time, source: Source, bit_rate: u32, what: What) {
        if self.error_frame.is_none_or(|(raiser, until)| raiser == source || now > until) {
            let span = ERROR_FRAME_BITS * 1_000_000_000_000 / u64::from(bit_rate);
            self.error_frame = Some((source, now + Time::from_ps(span)));
            self.push(now, source, what);
        }
    }

    /// Equal frames of several senders that overlap in time are one frame on the wire.
    fn frame(&mut self, source: Source, frame: Frame, start: Time, end: Time, bit_rate: u32) {
        for event in self.events.iter_mut().rev().take_while(|event| event.time > start) {
            if let What::Frame { frame: other, also, .. } = &mut event.what
                && *other == frame
            {
                also.push(source);
                return;
            }
        }
        self.push(end, source, What::Frame { frame, start, bit_rate, also: Vec::new() });
    }

    /// Takes what a board's program did to its controller.
    pub fn take_notes(&mut self, board: usize, chip: &mut Chip) {
        let bxcan = chip.can1_mut();
        for (time, note) in bxcan.take_notes() {
            let what = match note {
                Note::Requested { mailbox, frame } => What::Requested { mailbox, frame },
                Note::Aborted { mailbox, frame } => What::Aborted { mailbox, frame },
                Note::BitTiming(btr) => What::BitTiming { btr, bit_rate: bxcan.bit_rate() },
                Note::InitializationEntered => What::InitializationEntered,
                Note::InitializationLeft => What::InitializationLeft,
            };
            self.push(time, Source::Board(board), what);
        }
    }
}
