//! A CAN protocol controller without mailboxes: its clock, its position in the bit, and the events for its owner.

mod bit;
mod line;
mod protocol;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;

use super::{
    Frame,
    fault::ErrorCounters,
    stream::{BitStream, Decoder, Level},
    timing::{BitSegments, Clock, Mode, Spans},
};
use crate::Time;
use line::Line;
pub use line::{Pins, Transmit};
use protocol::Phase;

/// An error that a controller detects (ISO 11898-1, error detection).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum ErrorKind {
    /// Six equal bits where a stuff bit was due.
    Stuff,
    /// A dominant bit in a field that must be recessive, seen by a receiver or in an error delimiter.
    Form,
    Acknowledgement,
    /// A recessive bit was sent and a dominant one seen.
    BitRecessive,
    /// A dominant bit was sent and a recessive one seen.
    BitDominant,
    Crc,
}

impl ErrorKind {
    /// Its last error code in ESR (RM0090 32.9.2) and PSR (RM0440 44.4.12).
    pub(super) fn code(self) -> u32 {
        match self {
            Self::Stuff => 1,
            Self::Form => 2,
            Self::Acknowledgement => 3,
            Self::BitRecessive => 4,
            Self::BitDominant => 5,
            Self::Crc => 6,
        }
    }
}

/// An event for the owner, at the sample point or bit boundary where it happens.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    Started,
    /// The last bit of EOF was sampled recessive: the frame was sent from `start`, the first edge of its SOF, to `end`.
    Transmitted {
        frame: Frame,
        start: Time,
        end: Time,
    },
    /// Another station sends a frame of higher priority; the controller receives it.
    ArbitrationLost,
    /// A frame is valid: the last bit but one of EOF was sampled recessive.
    Received(Frame),
    Error {
        kind: ErrorKind,
        transmitting: bool,
    },
    /// A counter rose because other stations hold the bus dominant after an error flag.
    CounterRaised,
    /// The transmit error counter passed 255: the controller left the bus.
    BusOff,
    /// During bus-off recovery 11 recessive bits have passed.
    BusIdle,
    /// Bus-off recovery has finished, in which 11 recessive bits passed 128 times or more: the counters are zero.
    Recovered,
    /// The first 11 recessive bits since the start have passed.
    Joined,
    /// A requested stop that had to wait for the end of a frame has happened.
    Stopped,
    /// The wire became dominant while the controller was stopped and watching.
    Activity,
}

/// A CAN 2.0B controller (ISO 11898-1) with one bit timing, between its owner and the [`Bus`](super::Bus).
///
/// The owner offers the frame to send next and keeps offering it until it is transmitted: the controller repeats a
/// frame for as long as it is offered.
#[derive(Debug)]
pub struct Controller {
    clock: Clock,
    bit_timing: BitSegments,
    mode: Mode,
    spans: Spans,
    phase: Phase,
    /// The latest instant in which it took part, and the level of the wire then.
    now: Time,
    wire: Level,
    line: Line,
    /// The start of the bit with the next sample point; it may be in the future.
    start: Time,
    /// The level driven up to `start`, and the one from `start` on.
    driven: Level,
    next: Level,
    /// The level at the previous sample point, and whether an edge has been used since.
    sampled: Level,
    synchronised: bool,
    /// The frame to send next, and the earliest start of its SOF.
    offered: Option<(Time, Frame)>,
    transmission: Option<Transmission>,
    decoder: Decoder,
    /// Whether the current or latest frame is its own.
    transmitter: bool,
    frame_start: Time,
    /// An acknowledgement error went uncounted; a dominant bit in the passive error flag makes it count.
    unacknowledged: bool,
    counters: ErrorCounters,
    /// How often 11 recessive bits pass in bus-off recovery.
    recovery: u8,
    stopping: bool,
    watching: bool,
    events: VecDeque<Event>,
}

/// An own frame on the wire.
#[derive(Debug)]
struct Transmission {
    frame: Frame,
    stream: BitStream,
    /// Index of the bit that is driven, including stuff bits.
    index: u8,
}

impl Controller {
    pub fn new(clock: Clock, bit_timing: BitSegments) -> Self {
        Self {
            clock,
            bit_timing,
            mode: Mode::default(),
            spans: Spans::new(clock, bit_timing),
            phase: Phase::Stopped,
            now: Time::ZERO,
            wire: Level::Recessive,
            line: Line::default(),
            start: Time::ZERO,
            driven: Level::Recessive,
            next: Level::Recessive,
            sampled: Level::Recessive,
            synchronised: false,
            offered: None,
            transmission: None,
            decoder: Decoder::default(),
            transmitter: false,
            frame_start: Time::ZERO,
            unacknowledged: false,
            counters: ErrorCounters::default(),
            recovery: 128,
            stopping: false,
            watching: false,
            events: VecDeque::new(),
        }
    }

    /// Changes the clock at once, as a chip does when its prescalers are programmed.
    pub fn set_clock(&mut self, clock: Clock) {
        self.clock = clock;
        self.spans = Spans::new(clock, self.bit_timing);
    }

    /// Sets bit timing and mode.
    ///
    /// # Panics
    /// The controller is not stopped.
    pub fn configure(&mut self, bit_timing: BitSegments, mode: Mode) {
        assert!(self.is_stopped(), "bit timing changes only while the controller is stopped");
        self.bit_timing = bit_timing;
        self.mode = mode;
        self.spans = Spans::new(self.clock, bit_timing);
    }

    /// Sets how often 11 recessive bits pass in bus-off recovery, 128 at first.
    pub fn set_recovery(&mut self, sequences: u8) {
        self.recovery = sequences;
    }

    /// Begins to take part after 11 recessive bits, or after bus-off recovery if the controller is bus-off.
    ///
    /// Cancels a waiting stop; does nothing if the controller runs.
    pub fn start(&mut self, now: Time) {
        self.stopping = false;
        self.watching = false;
        if self.is_stopped() {
            self.now = now;
            self.start = now;
            self.sampled = Level::Recessive;
            self.synchronised = false;
            self.phase = Phase::joining(self.counters);
        }
    }

    /// Begins bus-off recovery: 128 times 11 recessive bits, or more. Does nothing in any other state.
    pub fn recover(&mut self, now: Time) {
        if self.phase == Phase::BusOff {
            self.start = self.start.max(now);
            self.phase = Phase::joining(self.counters);
        }
    }

    /// Stops at once if no frame or error frame is under way, otherwise at its end with [`Event::Stopped`].
    pub fn stop(&mut self) {
        if self.is_quiet() {
            self.halt();
        } else {
            self.stopping = true;
        }
    }

    /// Stops at once, whatever is under way; the counters stay.
    pub fn halt(&mut self) {
        self.transmission = None;
        self.phase = Phase::Stopped;
        self.stopping = false;
        self.driven = Level::Recessive;
        self.next = Level::Recessive;
        self.follow_line(self.now);
    }

    /// Stops at once, whatever is under way, and clears counters, offer and unread events: a hardware reset.
    pub fn reset(&mut self) {
        let (now, wire, mut line) = (self.now, self.wire, std::mem::take(&mut self.line));
        line.reset();
        let recovery = self.recovery;
        *self = Self { now, wire, line, recovery, ..Self::new(self.clock, self.bit_timing) };
        self.follow_line(now);
    }

    /// Whether a stopped controller reports [`Event::Activity`]; a start ends it.
    pub fn watch(&mut self, watching: bool) {
        self.watching = watching;
    }

    /// Replaces the frame to send next; its SOF starts at `from` or later. A frame under way continues.
    pub fn offer(&mut self, frame: Option<Frame>, from: Time) {
        self.offered = frame.map(|frame| (from, frame));
        if self.phase == Phase::Idle && !self.synchronised {
            self.schedule();
        }
    }

    pub fn clock(&self) -> Clock {
        self.clock
    }

    pub fn bit_rate(&self) -> u32 {
        self.bit_timing.bit_rate(self.clock.hz)
    }

    pub fn mode(&self) -> Mode {
        self.mode
    }

    pub fn counters(&self) -> ErrorCounters {
        self.counters
    }

    pub fn is_stopped(&self) -> bool {
        self.phase == Phase::Stopped
    }

    /// Whether the controller has seen its 11 recessive bits since the start.
    pub fn is_joined(&self) -> bool {
        match self.phase {
            Phase::Stopped | Phase::Integrating { .. } => false,
            Phase::Recovering { sequences, .. } => sequences > 0,
            _ => true,
        }
    }

    /// During bus-off recovery, how often 11 recessive bits have passed.
    pub fn recovered_sequences(&self) -> Option<u8> {
        match self.phase {
            Phase::Recovering { sequences, .. } => Some(sequences),
            _ => None,
        }
    }

    /// Whether one of its frames is under way.
    pub fn is_transmitting(&self) -> bool {
        self.transmission.is_some()
    }

    /// Whether another station's frame is under way.
    pub fn is_receiving(&self) -> bool {
        self.phase.is_frame() && self.transmission.is_none()
    }

    /// Whether one of its frames is going to start at the next bit boundary.
    pub fn is_starting(&self) -> bool {
        self.phase == Phase::Idle && self.next == Level::Dominant
    }

    pub fn bit_time(&self) -> Time {
        self.spans.bit
    }

    /// The sample point of the SOF of the current or latest frame.
    pub fn start_of_frame_sample(&self) -> Time {
        self.frame_start + self.spans.sample
    }

    /// The level of the wire at the latest instant that the bus reported.
    pub fn wire_level(&self) -> Level {
        self.wire
    }

    /// The level at the latest sample point.
    pub fn sampled_level(&self) -> Level {
        self.sampled
    }

    /// The latest instant that the bus reported.
    pub fn now(&self) -> Time {
        self.now
    }

    pub(super) fn take_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    fn may_transmit(&self) -> bool {
        !self.mode.silent || self.mode.loopback
    }

    /// Makes the offered frame the current transmission, starting at bit `index`.
    fn begin_transmission(&mut self, index: u8) {
        let Some((_, frame)) = self.offered else { return };
        self.transmission = Some(Transmission { stream: BitStream::new(&frame), frame, index });
        self.transmitter = true;
        self.events.push_back(Event::Started);
    }
}
