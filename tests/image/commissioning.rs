//! Blank release images on one bus, commissioned by a test master that waits no longer than the boards' answer time:
//! how close it comes to the limit of the bus.

use std::{
    env,
    io::{self, Write},
};

use emulator::{
    Time,
    can::{Frame, Id},
    network::Recording,
};
use lss_slave::{BitRate, lss};
use testkit::{
    frames,
    image_rig::{ImageRig, board_with, on_the_wire, settings},
};

const BIT_RATE: BitRate = BitRate::Kbit1000;
/// The longest time from the end of a request until the answer is on the bus.
const ANSWER_TIME: Time = Time::from_us(8);
/// The same for store configuration, by the slowest flash.
const STORE_TIME: Time = Time::from_ms(2);
/// The time until the bus is free again after a frame, and for the rounding of both.
const INTERMISSION_BITS: u64 = 4;

/// A master that is alone on the bus with the boards.
struct Master {
    rig: ImageRig,
    /// The number of requests, and of those that were answered.
    requests: u32,
    answers: u32,
}

impl Master {
    fn new(boards: u8) -> Self {
        let blank = |number| board_with(number, settings(0xFF, BIT_RATE));
        let mut rig = ImageRig::new(BIT_RATE, (0..boards).map(blank));
        rig.network.record(Recording::Latest(1_000));
        Self { rig, requests: 0, answers: 0 }
    }

    fn bits(&self, frame: &Frame) -> Time {
        self.rig.bit_time() * (u64::from(frame.wire_bits()) + INTERMISSION_BITS)
    }

    /// Sends a request; returns the answer, or `None` if there was none within the time for `expected`.
    fn ask(&mut self, request: &str, expected: &str, answer_time: Time) -> Option<Frame> {
        let request = on_the_wire(&frames::request(request));
        let mut answer = frames::request(expected);
        answer = lss_slave::Frame::new(lss::RESPONSE_COB_ID, answer.data()).expect("eight bytes");
        let span = self.bits(&request) + answer_time + self.bits(&on_the_wire(&answer));
        self.rig.network.send(self.rig.master, request);
        self.requests += 1;
        let received = self.rig.network.run_until_received(self.rig.master, span);
        self.answers += u32::from(received.is_some());
        received.map(|(_, frame)| frame)
    }

    /// Sends a request that has no answer.
    fn send(&mut self, request: &str) {
        let request = on_the_wire(&frames::request(request));
        let span = self.bits(&request);
        self.rig.network.send(self.rig.master, request);
        self.requests += 1;
        self.rig.network.run_for(span);
    }

    /// A Fastscan step: whether an unconfigured board has the bits of `number` from `bit` up in part `sub` of its LSS
    /// address.
    fn matches(&mut self, number: u32, bit: u8, sub: u8, next: u8) -> bool {
        let number = frames::number(number);
        let request = format!("51 {number} {bit:02X} {sub:02X} {next:02X}");
        self.ask(&request, "4F", ANSWER_TIME).is_some()
    }

    /// Finds one board whose parts that are `Some` are known, and leaves it in LSS configuration state.
    fn find(&mut self, known: [Option<u32>; 4]) -> Option<[u32; 4]> {
        if !self.matches(0, 0x80, 0, 0) {
            return None;
        }
        let mut found = [0; 4];
        for sub in 0..4_u8 {
            let part = known[usize::from(sub)].unwrap_or_else(|| {
                (0..32).rev().fold(0, |part, bit| {
                    if self.matches(part, bit, sub, sub) { part } else { part | 1 << bit }
                })
            });
            assert!(self.matches(part, 0, sub, (sub + 1) % 4), "part {sub} of {found:08X?}");
            found[usize::from(sub)] = part;
        }
        Some(found)
    }

    /// Gives the board in LSS configuration state a node-ID and stores it; returns once it has booted up.
    fn name(&mut self, node_id: u8) {
        let answer = self.ask(&format!("11 {node_id:02X}"), "11", ANSWER_TIME);
        assert_eq!(answer.map(|frame| frame.payload()[1]), Some(0));
        let answer = self.ask("17", "17", STORE_TIME);
        assert_eq!(answer.map(|frame| frame.payload()[1]), Some(0));
        let boot_up = Id::Standard(0x700 + u16::from(node_id));
        let answer = self.ask("04 00", "00", ANSWER_TIME * 4);
        assert_eq!(answer.map(|frame| frame.id), Some(boot_up));
    }

    /// Gives all boards node-IDs from 1 on, and prints the time for each.
    fn commission(&mut self, boards: u8, what: &str, known: [Option<u32>; 4], floor_ms: f64) {
        let began = self.rig.network.now();
        let mut serials = Vec::new();
        while let Some([.., serial]) = self.find(known) {
            serials.push(serial);
            self.name(serials.len() as u8);
            if serials.len().is_multiple_of(8) && boards > 16 {
                eprint!("\r{} of {boards} boards", serials.len());
                let _ = io::stderr().flush();
            }
        }
        let span = (self.rig.network.now() - began).as_ms() as f64;
        let each = span / f64::from(boards);
        println!(
            "{boards} boards, {what}: {:.2} s, {each:.1} ms a node, {:.2} of the floor ({floor_ms} ms); \
             {} requests, {} answers",
            span / 1000.0,
            each / floor_ms,
            self.requests,
            self.answers
        );
        serials.sort_unstable();
        serials.dedup();
        assert_eq!(serials.len(), usize::from(boards), "each board has a node-ID of its own");
        assert!(each / floor_ms < 1.1, "{each} ms a node");
    }
}

/// The number of boards: 8, or the value of `BOARDS`, up to 127.
fn boards() -> u8 {
    env::var("BOARDS").map_or(8, |text| text.parse().expect("BOARDS is a number up to 127"))
}

#[test]
fn blank_boards_with_unknown_serial_numbers_are_commissioned_at_bus_speed() {
    let mut master = Master::new(boards());
    master.send("04 01");
    let mut part = |request: &str| {
        let answer = master.ask(request, request, ANSWER_TIME).expect("an answer");
        let mut number = [0; 4];
        number.copy_from_slice(&answer.payload()[1..5]);
        Some(u32::from_le_bytes(number))
    };
    let known = [part("5A"), part("5B"), part("5C"), None];
    master.send("04 00");
    master.commission(boards(), "serial number unknown", known, 10.5);
}

#[test]
fn unknown_blank_boards_are_commissioned_at_bus_speed() {
    Master::new(boards()).commission(boards(), "nothing known", [None; 4], 36.4);
}
