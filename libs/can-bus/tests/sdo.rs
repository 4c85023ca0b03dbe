//! The SDO client with a server of others: the length of a value that is announced and said once more in its last segment.

use std::{
    collections::VecDeque,
    sync::Arc,
    time::{Duration, Instant},
};

use can_bus::{
    adapter::{Adapter, Mode, Received},
    bus::Bus,
    sdo,
    stop::Stop,
};
use canopen_node::{BitRate, Frame};

/// A server with node-ID 5 that gives these answers, one to each request.
struct Server {
    answers: VecDeque<[u8; 8]>,
    sent: VecDeque<Frame>,
}

impl Adapter for Server {
    fn open(&mut self, _: BitRate, _: Mode) -> Result<(), Stop> {
        Ok(())
    }

    fn close(&mut self) -> Result<(), Stop> {
        Ok(())
    }

    fn send(&mut self, request: &Frame) -> Result<(), Stop> {
        assert_eq!(request.cob_id(), 0x605);
        let answer = self.answers.pop_front().expect("a request that has an answer");
        self.sent.extend(Frame::new(0x585, &answer));
        Ok(())
    }

    fn receive(&mut self, _: Duration) -> Result<Option<Received>, Stop> {
        let received = |frame| Received { frame, at: Duration::ZERO, here: Instant::now() };
        Ok(self.sent.pop_front().map(received))
    }

    fn description(&self) -> String {
        "a server within the process".into()
    }
}

/// What the client reads from 1008h.
fn read(answers: &[[u8; 8]]) -> Result<Vec<u8>, sdo::Error> {
    let server = Server { answers: answers.iter().copied().collect(), sent: VecDeque::new() };
    let mut bus = Bus::new(Box::new(server), Duration::ZERO, Arc::default());
    sdo::read(&mut bus, 5, 0x1008, 0).expect("a bus")
}

#[test]
fn a_last_segment_that_does_not_say_its_length_is_as_long_as_announced() {
    let announced = |len| [0x41, 0x08, 0x10, 0, len, 0, 0, 0];
    let unannounced = [0x40, 0x08, 0x10, 0, 0, 0, 0, 0];
    let first = *b"\x00Encoder";
    let last = |command| [command, b' ', b'2', 0, 0, 0, 0, 0];
    for (start, last, value) in [
        // n = 0: no length is said in the segment.
        (announced(9), last(0x11), &b"Encoder 2"[..]),
        // n = 5, announced rightly, wrongly, and not at all.
        (announced(9), last(0x1B), b"Encoder 2"),
        (announced(8), last(0x1B), b"Encoder 2"),
        (announced(12), last(0x1B), b"Encoder 2"),
        (unannounced, last(0x1B), b"Encoder 2"),
        // Nowhere.
        (unannounced, last(0x11), b"Encoder 2\0\0\0\0\0"),
    ] {
        assert_eq!(read(&[start, first, last]).as_deref(), Ok(value), "{start:02X?} {last:02X?}");
    }
}

#[test]
fn an_abort_within_a_value_is_told() {
    let start = [0x41, 0x08, 0x10, 0, 9, 0, 0, 0];
    let abort = [0x80, 0x08, 0x10, 0, 0, 0, 0, 8];
    assert_eq!(read(&[start, abort]), Err(sdo::Error::Abort(0x0800_0000)));
}
