//! The trace of a network's first bus: frames, error frames, and the boards' actions on their CAN controllers.

use std::fmt;

use super::AdapterId;
use crate::{
    Time,
    can::{self, Controller, ErrorKind, Frame, Note, Peripheral},
    chip::ResetCause,
};

/// The number of bits after the first error within which errors of others belong to the same error frame.
const ERROR_FRAME_BITS: u64 = 20;

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Source {
    Board(usize),
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

/// An entry of the trace.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Event {
    /// The time; for a frame, the end of its last EOF bit.
    pub time: Time,
    /// The source; for a frame its first sender, for an error frame the station that raised it first.
    pub source: Source,
    pub what: What,
}

/// The kind of an event.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum What {
    /// A frame was sent on the bus, by `also` at the same time; `bit_rate` is its sender's nominal one in bit/s.
    Frame {
        frame: Frame,
        start: Time,
        bit_rate: u32,
        also: Vec<Source>,
    },
    /// An error frame began, active or passive.
    Error {
        kind: ErrorKind,
        transmitting: bool,
    },
    /// A board requested a transmission from this mailbox, 0..=2.
    Requested {
        mailbox: usize,
        frame: Frame,
    },
    /// A board emptied this mailbox, whose frame was not being sent.
    Aborted {
        mailbox: usize,
        frame: Frame,
    },
    /// A board changed its bit timing; `bit_rate` is nominal, in bit/s.
    BitTiming {
        btr: u32,
        bit_rate: u32,
    },
    InitializationEntered,
    InitializationLeft,
    /// A controller went bus-off.
    BusOff,
    /// A controller finished its bus-off recovery.
    Recovered,
    Reset(ResetCause),
    /// A board lost its supply.
    PowerOff,
    /// The supply of a board was restored.
    PowerOn,
}

/// A line of a log: time in milliseconds, source, event.
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

/// The amount of trace that is kept.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Recording {
    #[default]
    All,
    /// At least this number of the latest events, and at most twice as many.
    Latest(usize),
    Off,
}

/// The events so far, in order of time.
#[derive(Default)]
pub(super) struct Trace {
    recording: Recording,
    events: Vec<Event>,
    /// The station that raised the latest error frame, and the time until which errors of others belong to it.
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

    /// Adds an event at its place in time, which need not be the last: boards run ahead of the bus.
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

    /// Records a report of a controller on the wire.
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

    /// Records an action of a board's program on its controller.
    pub fn take_notes(&mut self, board: usize, can: &mut dyn Peripheral) {
        for (time, note) in can.take_notes() {
            let what = match note {
                Note::Requested { mailbox, frame } => What::Requested { mailbox, frame },
                Note::Aborted { mailbox, frame } => What::Aborted { mailbox, frame },
                Note::BitTiming(btr) => What::BitTiming { btr, bit_rate: can.bit_rate() },
                Note::InitializationEntered => What::InitializationEntered,
                Note::InitializationLeft => What::InitializationLeft,
            };
            self.push(time, Source::Board(board), what);
        }
    }
}
