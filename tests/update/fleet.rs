//! A program for all boards of a bus, one after the other: while one takes it, the next ones clear, and the one before
//! starts.

use canopen_node::{BitRate, Frame};
use emulator::{
    Time,
    can::Adapter,
    image::Image,
    network::{AdapterId, Event, Recording, What},
};
use testkit::{
    image_rig::{ImageRig, settings},
    product,
    sdo::Client,
    wire::{bit_per_s, on_the_wire},
};

use super::rig::{CONTROLLER, IMAGES, PART, board_of, padded_of};

/// How many boards ahead of the download clear: a clear takes as long as three downloads at 1 Mbit/s.
const AHEAD: usize = 4;
const KB: usize = 40;

/// The node-IDs of up to eight boards. With some of them a segment has one or two stuff bits more: with 15 and those that
/// 4 divides, a share as of all 127.
fn nodes(count: u8) -> Vec<u8> {
    (15..15 + count).collect()
}

/// A master of boards. An adapter stands for the other boards of the bus: they only send heartbeats.
struct Fleet {
    rig: ImageRig,
    nodes: Vec<u8>,
    others: AdapterId,
    /// The heartbeats of the others so far.
    heartbeats: u64,
}

impl Fleet {
    fn new(count: u8, rate: BitRate, heartbeat_ms: u16, old: &[u8]) -> Self {
        let stored = |node| settings(node, rate).with_heartbeat_ms(heartbeat_ms);
        let nodes = nodes(count);
        let mut rig = ImageRig::new(rate, nodes.iter().map(|node| board_of(old, stored(*node))));
        rig.network.permit_misuse();
        rig.network.record(Recording::Latest(1000));
        let others = rig.network.add_adapter(Adapter::new(bit_per_s(rate)));
        rig.collect(Time::from_ms(100));
        Self { rig, nodes, others, heartbeats: 0 }
    }

    /// Sends the heartbeats of all others that are due, one each second.
    fn beat(&mut self) {
        let others: Vec<u8> = (1..=127).filter(|node| !self.nodes.contains(node)).collect();
        let due = self.rig.network.now().as_ms() * others.len() as u64 / 1000;
        for number in self.heartbeats..due {
            let node = others[number as usize % others.len()];
            let heartbeat = Frame::new(0x700 + u16::from(node), &[0x7F]).expect("a byte");
            self.rig.network.send(self.others, on_the_wire(&heartbeat));
        }
        self.heartbeats = due;
    }

    fn number(&mut self, node: u8, index: u16) -> u32 {
        self.rig.sdo_client(node).number(index, 1)
    }

    fn control(&mut self, node: u8, value: u8) {
        assert_eq!(self.rig.sdo_client(node).download(0x1F51, 1, &[value]), Ok(()), "node {node}");
    }

    /// Asks a node to stop, without a wait for the answer.
    fn ask_to_stop(&mut self, node: u8) {
        let stop = [0x2F, 0x51, 0x1F, 1, 0, 0, 0, 0];
        self.rig.queue(&Frame::new(0x600 + u16::from(node), &stop).expect("eight bytes"));
    }

    fn clear(&mut self, node: u8) {
        while self.number(node, 0x1F51) != 0 {}
        self.control(node, 3);
    }

    fn confirm(&mut self, node: u8, crc: u32) {
        assert_eq!(self.number(node, 0x1F51), 1, "node {node}");
        assert_eq!(self.number(node, 0x1F56), crc, "node {node}");
        self.control(node, 0x80);
    }

    /// Installs a program on all boards. Returns the time at which each has taken it, and that of the end.
    fn install(&mut self, file: &[u8], has_heartbeats: bool) -> Vec<Time> {
        let crc = u32::from_le_bytes(*file[12..].first_chunk().expect("a header"));
        let from = self.rig.network.now();
        let mut times = Vec::new();
        let nodes = self.nodes.clone();
        let first = &nodes[..nodes.len().min(AHEAD)];
        first.iter().for_each(|node| self.ask_to_stop(*node));
        self.rig.collect(Time::from_ms(20));
        first.iter().for_each(|node| self.clear(*node));
        let mut before = None;
        for (at, node) in nodes.iter().copied().enumerate() {
            if has_heartbeats {
                self.beat();
            }
            let next = nodes.get(at + AHEAD).copied();
            next.into_iter().for_each(|next| self.ask_to_stop(next));
            while self.number(node, 0x1F57) & 1 == 1 {
                self.rig.collect(Time::from_ms(5));
            }
            let outcome = self.rig.sdo_client(node).block_download(0x1F50, 1, file);
            assert_eq!(outcome, Ok(()), "node {node}");
            next.into_iter().for_each(|next| self.clear(next));
            before.into_iter().for_each(|before| self.confirm(before, crc));
            self.control(node, 1);
            before = Some(node);
            times.push(self.rig.network.now() - from);
        }
        if let Some(last) = before {
            // The boot-up of its loader may come as late as now. The reset takes 100 ms.
            self.rig.collect(Time::from_ms(100));
            self.rig.expect(&format!("7{last:02X}: 00"), Time::from_s(1));
            self.confirm(last, crc);
        }
        times.push(self.rig.network.now() - from);
        times
    }
}

/// Installs a program of 40 KB, or more if it has more, on this number of boards, maybe beside the heartbeats of 127
/// boards. Returns the time, and the time for 127 boards: each further one takes as long as these after the first.
fn update(program: &Image, count: u8, rate: BitRate, has_heartbeats: bool) -> [Time; 2] {
    let file = padded_of(program, "0.2.0", KB);
    let heartbeat_ms = if has_heartbeats { 1000 } else { 0 };
    let mut fleet = Fleet::new(count, rate, heartbeat_ms, &padded_of(program, "0.1.0", KB));
    let times = fleet.install(&file, has_heartbeats);
    for (board, node) in fleet.nodes.clone().into_iter().enumerate() {
        let version = fleet.rig.sdo_client(node).upload(0x100A, 0);
        assert_eq!(version, Ok(b"0.2.0".to_vec()), "node {node}");
        assert_eq!(fleet.number(node, 0x2001), 3, "node {node}");
        let board = fleet.rig.network.board(board);
        assert_eq!((board.misuse(), board.resets().len()), (None, 3), "node {node}");
    }
    let is_error = |event: &&Event| matches!(event.what, What::Error { .. });
    assert_eq!(fleet.rig.network.trace().iter().filter(is_error).count(), 0);
    let [first, .., last, end] = times[..] else { panic!("two boards") };
    let each = Time::from_ps((last - first).as_ps() / u64::from(count - 1));
    let all = end + each * (127 - u64::from(count));
    let (kb, kbit) = (file.len() as f64 / 1024.0, rate.kbit_per_s());
    let heartbeats = if has_heartbeats { ", heartbeats" } else { "" };
    let what =
        format!("127 boards, {count} of them emulated: {kb:.1} KB, {kbit} kbit/s{heartbeats}");
    println!("{what:68} {:8.1} s", all.as_ps() as f64 / 1e12);
    [end, all]
}

#[test]
fn five_boards_get_a_program_one_after_the_other() {
    let [time, all] = update(&IMAGES[1], 5, BitRate::Kbit1000, true);
    assert!(time < Time::from_ms(5700));
    assert!(all < Time::from_s(95));
}

#[test]
#[ignore = "a campaign of minutes"]
fn on_127_boards_40_kb_take_90_s_at_1_mbit_and_12_min_at_125_kbit() {
    // Without the text of a panic the product has less than 40 KB.
    let lean = product::build_program("lean", PART, CONTROLLER, |path, content| match path {
        "Cargo.toml" => content.replace("default = [\"panic-message\"]", "default = []"),
        _ => content,
    });
    let lean = lean.unwrap_or_else(|error| panic!("{error}"));
    for (rate, has_heartbeats, limit) in [
        (BitRate::Kbit1000, false, 90),
        (BitRate::Kbit1000, true, 91),
        (BitRate::Kbit125, false, 12 * 60),
        (BitRate::Kbit125, true, 12 * 60),
    ] {
        let [_, all] = update(&lean, 8, rate, has_heartbeats);
        assert!(all < Time::from_s(limit));
    }
}
