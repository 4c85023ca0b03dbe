//! A controller's reaction at each sample point (ISO 11898-1, medium access control).

use super::{Controller, ErrorKind, Event, Transmission};
use crate::{
    Time,
    can::{
        Id,
        fault::ErrorCounters,
        stream::{Decoder, Level, Progress},
    },
};

/// Recessive bits after which a controller takes part, and which make one step of bus-off recovery.
const IDLE_BITS: u8 = 11;
/// Positions of the RTR bit, the last of the arbitration field, in the base and the extended format.
const BASE_RTR: u8 = 12;
const EXTENDED_RTR: u8 = 32;

/// The controller's position in the protocol. Bits are counted from zero and name the bit that is sampled next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Phase {
    Stopped,
    Integrating {
        recessive: u8,
    },
    Idle,
    /// SOF to CRC sequence.
    Frame,
    CrcDelimiter,
    AckSlot,
    AckDelimiter,
    EndOfFrame {
        bit: u8,
    },
    Flag {
        flag: Flag,
        bits: u8,
    },
    /// Its own flag is over, others may still be sending theirs.
    FlagEnd {
        flag: Flag,
        dominant: u32,
    },
    Delimiter {
        bit: u8,
    },
    Intermission {
        bit: u8,
    },
    Suspend {
        bit: u8,
    },
    BusOff,
    Recovering {
        sequences: u8,
        recessive: u8,
    },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Flag {
    ActiveError,
    PassiveError,
    Overload,
}

impl Phase {
    /// The phase before taking part in the bus.
    pub fn joining(counters: ErrorCounters) -> Self {
        if counters.bus_off() {
            Self::Recovering { sequences: 0, recessive: 0 }
        } else {
            Self::Integrating { recessive: 0 }
        }
    }

    pub fn is_frame(self) -> bool {
        matches!(
            self,
            Self::Frame
                | Self::CrcDelimiter
                | Self::AckSlot
                | Self::AckDelimiter
                | Self::EndOfFrame { .. }
        )
    }

    /// Whether an edge now restarts the bit instead of moving it by at most the jump width.
    pub fn synchronises_hard(self) -> bool {
        match self {
            Self::Idle
            | Self::Suspend { .. }
            | Self::Integrating { .. }
            | Self::Recovering { .. } => true,
            Self::Intermission { bit } => bit > 0,
            _ => false,
        }
    }
}

impl Controller {
    /// Whether a stop would cut nothing off.
    pub(super) fn is_quiet(&self) -> bool {
        match self.phase {
            Phase::Idle => !self.synchronised,
            Phase::Stopped
            | Phase::Integrating { .. }
            | Phase::Intermission { .. }
            | Phase::Suspend { .. }
            | Phase::BusOff
            | Phase::Recovering { .. } => true,
            _ => false,
        }
    }

    /// Acts at a sample point.
    pub(in crate::can) fn sample(&mut self, now: Time, wire: Level) {
        self.now = now;
        let seen = self.take_sample(now, wire);
        if self.phase == Phase::Idle {
            self.start = now - self.spans.sample;
        }
        let previous = self.sampled;
        let began = self.start;
        self.sampled = seen;
        self.synchronised = false;
        self.start += self.spans.bit;
        self.next = Level::Recessive;
        let dominant = seen == Level::Dominant;

        match self.phase {
            Phase::Integrating { .. } if dominant => {
                self.phase = Phase::Integrating { recessive: 0 }
            }
            Phase::Integrating { recessive } if recessive + 1 < IDLE_BITS => {
                self.phase = Phase::Integrating { recessive: recessive + 1 };
            }
            Phase::Integrating { .. } => {
                self.events.push_back(Event::Joined);
                self.idle();
            }
            Phase::Idle if dominant => self.start_of_frame(began, true),
            Phase::Idle => self.idle(),
            Phase::Frame => self.frame_bit(seen),
            Phase::CrcDelimiter if dominant => self.fixed_form_error(),
            Phase::CrcDelimiter => {
                self.phase = Phase::AckSlot;
                if !self.transmitter && self.decoder.crc_matches() {
                    self.next = Level::Dominant;
                }
            }
            Phase::AckSlot if self.transmitter && !dominant && !self.mode.loopback => {
                self.error(ErrorKind::Acknowledgement);
            }
            Phase::AckSlot if self.driven == Level::Dominant && !dominant => {
                self.error(ErrorKind::BitDominant);
            }
            Phase::AckSlot => self.phase = Phase::AckDelimiter,
            Phase::AckDelimiter if dominant => self.fixed_form_error(),
            Phase::AckDelimiter if !self.transmitter && !self.decoder.crc_matches() => {
                self.error(ErrorKind::Crc)
            }
            Phase::AckDelimiter => self.phase = Phase::EndOfFrame { bit: 0 },
            Phase::EndOfFrame { bit } => self.end_of_frame_bit(bit, dominant),
            Phase::Flag { flag: Flag::PassiveError, bits } => {
                self.passive_flag_bit(if seen == previous { bits + 1 } else { 1 }, dominant);
            }
            // In the controller's own active error or overload flag.
            Phase::Flag { .. } if !dominant => self.fail(ErrorKind::BitDominant, 8),
            Phase::Flag { flag, bits } => self.flag_bit(flag, bits + 1),
            Phase::FlagEnd { flag, dominant: before } if dominant => {
                self.held_dominant(flag, before + 1)
            }
            Phase::FlagEnd { .. } => self.phase = Phase::Delimiter { bit: 1 },
            Phase::Delimiter { bit: 7 } if dominant => self.overload(),
            Phase::Delimiter { .. } if dominant => self.error(ErrorKind::Form),
            Phase::Delimiter { bit: 7 } => self.intermission(),
            Phase::Delimiter { bit } => self.phase = Phase::Delimiter { bit: bit + 1 },
            Phase::Intermission { bit: 2 } if dominant => {
                self.start_of_frame(began, !self.must_suspend())
            }
            Phase::Intermission { .. } if dominant => self.overload(),
            Phase::Intermission { bit: 2 } if self.must_suspend() => {
                self.phase = Phase::Suspend { bit: 0 }
            }
            Phase::Intermission { bit: 2 } => self.idle(),
            Phase::Intermission { bit } => self.phase = Phase::Intermission { bit: bit + 1 },
            Phase::Suspend { .. } if dominant => self.start_of_frame(began, false),
            Phase::Suspend { bit: 7 } => self.idle(),
            Phase::Suspend { bit } => self.phase = Phase::Suspend { bit: bit + 1 },
            Phase::Recovering { sequences, recessive } => {
                self.recovery_bit(sequences, recessive, dominant)
            }
            Phase::Stopped | Phase::BusOff => {}
        }
    }

    /// Handles a dominant bit where a frame may begin: joins with the offered frame, or receives.
    fn start_of_frame(&mut self, began: Time, may_join: bool) {
        self.frame_start = began;
        self.phase = Phase::Frame;
        self.transmitter = false;
        self.decoder = Decoder::default();
        self.decoder.push(Level::Dominant);
        if may_join && self.may_transmit() && self.offered.is_some_and(|(from, _)| from <= self.now)
        {
            self.begin_transmission(1);
            self.drive_frame();
        }
    }

    fn drive_frame(&mut self) {
        if let Some(transmission) = &self.transmission {
            self.next = transmission.stream.level(transmission.index);
        }
    }

    fn frame_bit(&mut self, seen: Level) {
        if let Some(transmission) = &mut self.transmission {
            if seen == self.driven {
                transmission.index += 1;
                self.drive_frame();
            } else {
                let base = matches!(transmission.frame.id, Id::Standard(_));
                let rtr = if base { BASE_RTR } else { EXTENDED_RTR };
                if seen == Level::Recessive {
                    return self.error(ErrorKind::BitDominant);
                } else if self.decoder.position() > rtr {
                    return self.error(ErrorKind::BitRecessive);
                } else if !self.decoder.stuff_bit_due() {
                    self.transmission = None;
                    self.transmitter = false;
                    self.events.push_back(Event::ArbitrationLost);
                }
            }
        }
        match self.decoder.push(seen) {
            Progress::Within => {}
            Progress::StuffError => self.error(ErrorKind::Stuff),
            Progress::CrcSequenceEnd => self.phase = Phase::CrcDelimiter,
        }
    }

    fn end_of_frame_bit(&mut self, bit: u8, dominant: bool) {
        match (bit, self.transmitter) {
            (6, false) if dominant => return self.overload(),
            _ if dominant => return self.fixed_form_error(),
            (5, false) => {
                self.counters.received();
                self.events.push_back(Event::Received(self.decoder.frame()));
            }
            (6, true) => {
                if self.mode.loopback {
                    self.events.push_back(Event::Received(self.decoder.frame()));
                }
                if let Some(Transmission { frame, .. }) = self.transmission.take() {
                    self.counters.transmitted();
                    let (start, end) = (self.frame_start, self.start);
                    self.events.push_back(Event::Transmitted { frame, start, end });
                }
            }
            _ => {}
        }
        if bit == 6 {
            self.intermission();
        } else {
            self.phase = Phase::EndOfFrame { bit: bit + 1 };
        }
    }

    /// Handles a dominant bit in a delimiter or in EOF.
    fn fixed_form_error(&mut self) {
        self.error(if self.transmitter { ErrorKind::BitRecessive } else { ErrorKind::Form });
    }

    /// Counts an error and begins the error flag for the previous state.
    fn error(&mut self, kind: ErrorKind) {
        self.fail(kind, if self.transmitter { 8 } else { 1 });
    }

    fn fail(&mut self, kind: ErrorKind, weight: u16) {
        let passive = self.counters.passive();
        self.unacknowledged = kind == ErrorKind::Acknowledgement && passive;
        // A transmitter sees a stuff error only in arbitration, where its recessive stuff bit was overwritten.
        let uncounted = self.unacknowledged || (self.transmitter && kind == ErrorKind::Stuff);
        if !uncounted {
            self.counters.raise(self.transmitter, weight);
        }
        self.transmission = None;
        self.events.push_back(Event::Error { kind, transmitting: self.transmitter });
        self.begin_flag(if passive { Flag::PassiveError } else { Flag::ActiveError });
        self.leave_if_bus_off();
    }

    fn overload(&mut self) {
        self.begin_flag(Flag::Overload);
    }

    fn begin_flag(&mut self, flag: Flag) {
        self.phase = Phase::Flag { flag, bits: 0 };
        if flag != Flag::PassiveError {
            self.next = Level::Dominant;
        }
    }

    fn flag_bit(&mut self, flag: Flag, bits: u8) {
        if bits < 6 {
            self.phase = Phase::Flag { flag, bits };
            self.next = Level::Dominant;
        } else {
            self.phase = Phase::FlagEnd { flag, dominant: 0 };
        }
    }

    /// A passive flag ends after six equal bits, no matter which station sends them.
    fn passive_flag_bit(&mut self, equal: u8, dominant: bool) {
        let flag = Flag::PassiveError;
        self.phase = match equal {
            6 => Phase::FlagEnd { flag, dominant: 0 },
            bits => Phase::Flag { flag, bits },
        };
        if dominant && self.unacknowledged {
            self.unacknowledged = false;
            self.raise_for_dominant_bits();
        }
    }

    /// Counts dominant bits after its own flag: the first penalises a receiver, each eighth any station.
    fn held_dominant(&mut self, flag: Flag, count: u32) {
        self.phase = Phase::FlagEnd { flag, dominant: count };
        if (count == 1 && flag != Flag::Overload && !self.transmitter) || count.is_multiple_of(8) {
            self.raise_for_dominant_bits();
        }
    }

    fn raise_for_dominant_bits(&mut self) {
        self.counters.raise(self.transmitter, 8);
        self.events.push_back(Event::CounterRaised);
        self.leave_if_bus_off();
    }

    fn leave_if_bus_off(&mut self) {
        if self.counters.bus_off() {
            self.next = Level::Recessive;
            self.phase = Phase::BusOff;
            self.events.push_back(Event::BusOff);
            self.stop_if_asked();
        }
    }

    fn recovery_bit(&mut self, sequences: u8, recessive: u8, dominant: bool) {
        let recessive = if dominant { 0 } else { recessive + 1 };
        if recessive < IDLE_BITS {
            self.phase = Phase::Recovering { sequences, recessive };
            return;
        }
        self.phase = Phase::Recovering { sequences: sequences + 1, recessive: 0 };
        self.events.push_back(Event::BusIdle);
        if sequences == 0 {
            self.events.push_back(Event::Joined);
        }
        if sequences + 1 == self.recovery {
            self.counters = ErrorCounters::default();
            self.transmitter = false;
            self.events.push_back(Event::Recovered);
            self.idle();
        }
    }

    fn must_suspend(&self) -> bool {
        self.transmitter && self.counters.passive()
    }

    fn intermission(&mut self) {
        self.phase = Phase::Intermission { bit: 0 };
        self.stop_if_asked();
    }

    fn idle(&mut self) {
        self.phase = Phase::Idle;
        self.stop_if_asked();
        if self.phase == Phase::Idle {
            self.schedule();
        }
    }

    fn stop_if_asked(&mut self) {
        if self.stopping {
            self.halt();
            self.events.push_back(Event::Stopped);
        }
    }
}
