//! A controller alone with a wire that a test drives bit by bit.

use super::*;
use crate::can::Id;

const TIMING: BitSegments =
    BitSegments { prescaler: 2, segment_1: 13, segment_2: 2, jump_width: 1 };

/// Steps a controller through bits: `0` is dominant, `1` recessive, spaces are ignored.
struct Line {
    controller: Controller,
    now: Time,
    level: Level,
    events: Vec<Event>,
}

impl Line {
    /// A controller that has seen its eleven recessive bits.
    fn idle() -> Self {
        let mut controller = Controller::new(Clock { hz: 32_000_000, ppm: 0 }, TIMING);
        controller.start(Time::ZERO);
        let mut line =
            Self { controller, now: Time::ZERO, level: Level::Recessive, events: Vec::new() };
        assert_eq!(line.bits("11111111111"), "11111111111");
        assert_eq!(line.take(), [Event::Joined]);
        line
    }

    fn offering(frame: Frame) -> Self {
        let mut line = Self::idle();
        line.controller.offer(Some(frame), line.now);
        line
    }

    /// Lets other stations drive the wire with `bits`, and returns the bits that the controller drove meanwhile.
    fn bits(&mut self, bits: &str) -> String {
        bits.chars().filter(|bit| *bit != ' ').map(|bit| self.bit(bit == '0')).collect()
    }

    fn bit(&mut self, dominant: bool) -> char {
        let boundary = self.controller.next_action();
        if self.controller.drives_at(boundary) {
            self.controller.drive(boundary);
        }
        let own = self.controller.output();
        let level = if dominant { Level::Dominant } else { own };
        if self.level == Level::Recessive && level == Level::Dominant {
            self.controller.falling_edge(self.now);
        }
        self.level = level;
        let sample = self.controller.next_action();
        if sample < Time::MAX {
            self.controller.sample(sample, level);
        }
        self.events.extend(std::iter::from_fn(|| self.controller.take_event()));
        self.now += Time::from_us(1);
        if own == Level::Dominant { '0' } else { '1' }
    }

    /// Lets another station send `frame` up to its CRC sequence.
    fn stuffed(&mut self, frame: &Frame) {
        let stream = BitStream::new(frame);
        for index in 0..(frame.wire_bits() - 10) as u8 {
            self.bit(stream.level(index) == Level::Dominant);
        }
    }

    fn take(&mut self) -> Vec<Event> {
        std::mem::take(&mut self.events)
    }

    fn counters(&self) -> (u16, u16) {
        (self.controller.counters.transmit, self.controller.counters.receive)
    }

    /// Sets the counters as if by earlier errors.
    fn count(&mut self, transmit: u16, receive: u16) {
        self.controller.counters = ErrorCounters { transmit, receive };
    }
}

fn frame() -> Frame {
    Frame::data(Id::Standard(0x2AA), &[0x5A])
}

fn error(kind: ErrorKind, transmitting: bool) -> Event {
    Event::Error { kind, transmitting }
}

#[test]
fn a_wrong_crc_is_not_acknowledged_and_flagged_after_the_ack_delimiter() {
    let mut line = Line::idle();
    let stream = BitStream::new(&frame());
    let length = (frame().wire_bits() - 10) as u8;
    // Exchange two bits of the CRC sequence, so that the stuffing remains valid.
    let wrong = (length - 8..length - 1)
        .find(|&at| {
            stream.level(at - 1) == stream.level(at + 1) && stream.level(at) != stream.level(at - 1)
        })
        .expect("an isolated bit");
    for index in 0..length {
        let flip = index == wrong;
        line.bit((stream.level(index) == Level::Dominant) != flip);
    }
    assert_eq!(line.bits("1 1 1 111111 1111"), "1110000001111");
    assert_eq!(line.take(), [error(ErrorKind::Crc, false)]);
    assert_eq!(line.counters(), (0, 1));
}

#[test]
fn a_dominant_bit_in_a_delimiter_or_before_the_last_two_of_eof_is_a_form_error() {
    for bits in ["0", "1 0 0", "1 0 1 11111 0"] {
        let mut line = Line::idle();
        line.stuffed(&frame());
        line.bits(bits);
        assert_eq!(line.take(), [error(ErrorKind::Form, false)], "{bits}");
    }
}

#[test]
fn a_dominant_last_bit_of_eof_is_an_overload_to_a_receiver() {
    let mut line = Line::idle();
    line.stuffed(&frame());
    line.bits("1 0 1 111111");
    assert_eq!(line.bits("0 111111 1111"), "10000001111");
    assert_eq!(line.take(), [Event::Received(frame())]);
    assert_eq!(line.counters(), (0, 0));
}

#[test]
fn a_dominant_last_bit_of_eof_fails_the_transmitter() {
    let mut line = Line::offering(frame());
    line.bits(&"1".repeat(frame().wire_bits() as usize - 9));
    line.bits("0 1 111111 0");
    assert_eq!(line.take(), [Event::Started, error(ErrorKind::BitRecessive, true)]);
    assert_eq!(line.counters(), (8, 0));
}

#[test]
fn a_dominant_bit_early_in_intermission_is_an_overload_and_counts_nothing() {
    for early in ["0", "10"] {
        let mut line = Line::idle();
        line.stuffed(&frame());
        line.bits("1 0 1 1111111");
        line.bits(early);
        // Overload flag, delimiter of eight, intermission.
        assert_eq!(line.bits("111111 11111111 111"), "00000011111111111");
        assert_eq!(line.take(), [Event::Received(frame())]);
        assert_eq!(line.counters(), (0, 0));
        assert_eq!(line.controller.next_action(), Time::MAX);
    }
}

#[test]
fn a_dominant_third_bit_of_intermission_starts_a_frame() {
    let mut line = Line::idle();
    line.stuffed(&frame());
    line.bits("1 0 1 1111111 11");
    line.stuffed(&frame());
    line.bits("1 0 1 1111111");
    assert_eq!(line.take(), [Event::Received(frame()), Event::Received(frame())]);
}

#[test]
fn a_waiting_frame_joins_a_start_of_frame_with_its_first_identifier_bit() {
    let mut line = Line::offering(frame());
    let wire = line.bits("0 1111");
    assert_eq!(line.take(), [Event::Started]);
    // 2AA is 01010101010: SOF came from the other station.
    assert_eq!(&wire[..5], "00101");

    let mut line = Line::idle();
    line.bits("1");
    line.stuffed(&frame());
    line.controller.offer(Some(frame()), line.now);
    line.bits("1 0 1 1111111 11");
    assert_eq!(line.bits("0 1111"), "10101");
}

#[test]
fn an_overwritten_stuff_bit_in_arbitration_does_not_raise_the_counter() {
    // SOF and four dominant bits, then the recessive stuff bit.
    let mut line = Line::offering(Frame::data(Id::Standard(0x07F), &[]));
    assert_eq!(line.bits("11111 0"), "000001");
    assert_eq!(line.take(), [Event::Started, error(ErrorKind::Stuff, true)]);
    assert_eq!(line.counters(), (0, 0));
}

#[test]
fn a_dominant_bit_in_an_error_delimiter_is_a_form_error_or_an_overload() {
    let mut line = Line::idle();
    line.bits("000000 111111 1110");
    let form = [error(ErrorKind::Stuff, false), error(ErrorKind::Form, false)];
    assert_eq!(line.take(), form);
    assert_eq!(line.bits("111111 1111111 0"), "00000011111111");
    assert_eq!(line.bits("111111 11111111 111"), "00000011111111111");
    assert_eq!(line.take(), []);
    assert_eq!(line.counters(), (0, 2));
}

#[test]
fn dominant_bits_after_its_flag_blame_a_receiver_by_eight_each_time() {
    let mut line = Line::idle();
    line.bits("000000 111111");
    assert_eq!(line.counters(), (0, 1));
    line.bits("0");
    assert_eq!(line.counters(), (0, 9));
    line.bits("000000");
    assert_eq!(line.counters(), (0, 9));
    line.bits("0");
    assert_eq!(line.counters(), (0, 17));
    line.bits("00000000");
    assert_eq!(line.counters(), (0, 25));
    line.bits("11111111 111");
    assert_eq!(line.controller.next_action(), Time::MAX);
}

#[test]
fn eight_dominant_bits_after_its_flag_blame_a_transmitter() {
    let mut line = Line::offering(frame());
    line.bits(&"1".repeat(frame().wire_bits() as usize - 9));
    line.bits("1");
    assert_eq!(line.take(), [Event::Started, error(ErrorKind::Acknowledgement, true)]);
    line.bits("111111 0000000");
    assert_eq!(line.counters(), (8, 0));
    line.bits("0");
    assert_eq!(line.counters(), (16, 0));
}

#[test]
fn a_passive_flag_is_recessive_and_ends_after_six_equal_bits() {
    let mut line = Line::idle();
    line.count(0, 130);
    // Six equal bits from any station: here the flags of others, shifted by one bit.
    assert_eq!(line.bits("000000 1 000000 11111111 111"), "1".repeat(24));
    assert_eq!(line.take(), [error(ErrorKind::Stuff, false)]);
    assert_eq!(line.controller.next_action(), Time::MAX);
}

#[test]
fn the_error_that_makes_a_node_passive_still_has_an_active_flag() {
    let mut line = Line::idle();
    line.count(0, 127);
    assert_eq!(line.bits("000000 111111"), "111111000000");
    assert!(line.controller.counters().passive());
}

#[test]
fn a_passive_nodes_acknowledgement_error_counts_only_if_others_flag_it() {
    for (flags, transmit) in [("111111", 128), ("111000000", 136)] {
        let mut line = Line::offering(frame());
        line.count(128, 0);
        line.bits(&"1".repeat(frame().wire_bits() as usize - 9));
        line.bits("1");
        line.bits(flags);
        assert_eq!(line.counters(), (transmit, 0));
    }
}

#[test]
fn a_passive_transmitter_waits_eight_bits_longer_and_receives_meanwhile() {
    let mut line = Line::offering(frame());
    line.count(130, 0);
    line.bits(&"1".repeat(frame().wire_bits() as usize - 9));
    line.bits("0 1 1111111");
    assert!(matches!(line.take()[..], [Event::Started, Event::Transmitted { .. }]));
    // Intermission and suspend; the same frame is still offered.
    assert_eq!(line.bits("111 11111111 1"), "111111111110");

    let mut line = Line::offering(frame());
    line.count(130, 0);
    line.bits(&"1".repeat(frame().wire_bits() as usize - 9));
    line.bits("0 1 1111111 111 1111");
    line.take();
    line.stuffed(&frame());
    assert_eq!(line.bits("1 1"), "10", "it acknowledges");
}

#[test]
fn a_good_frame_brings_the_receive_error_counter_down() {
    for (before, after) in [(0, 0), (1, 0), (127, 126), (128, 120), (255, 120)] {
        let mut line = Line::idle();
        line.count(0, before);
        line.stuffed(&frame());
        line.bits("1 0 1 1111111");
        assert_eq!(line.counters(), (0, after));
    }
}

#[test]
fn bus_off_releases_the_wire_within_the_bit() {
    let mut line = Line::offering(frame());
    line.count(248, 0);
    line.bits(&"1".repeat(19));
    line.bits("0");
    assert_eq!(line.take(), [Event::Started, error(ErrorKind::BitRecessive, true), Event::BusOff]);
    assert_eq!(line.bits("1111111"), "1111111");
    assert_eq!(line.controller.next_action(), Time::MAX);
}

#[test]
fn recovery_restarts_a_sequence_at_each_dominant_bit() {
    let mut line = Line::idle();
    line.count(256, 0);
    line.controller.phase = Phase::BusOff;
    line.controller.recover(line.now);
    line.bits("1111111111 0");
    line.bits(&"1".repeat(128 * 11 - 1));
    let mut expected = vec![Event::BusIdle; 128];
    expected[1] = Event::Joined;
    assert_eq!(line.take(), expected, "after 127 sequences");
    assert_eq!(line.controller.recovered_sequences(), Some(127));
    line.bits("1");
    assert_eq!(line.take(), [Event::BusIdle, Event::Recovered]);
    assert_eq!(line.controller.recovered_sequences(), None);
    assert_eq!(line.counters(), (0, 0));
}
