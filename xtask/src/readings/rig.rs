//! Boards of one reading and an LSS master on one bus, which answer with an error where a test would panic.

use anyhow::{Context, bail, ensure};
use emulator::{
    Time,
    board::{self, Board},
    can::{Adapter, Frame, Id},
    chip::{Part, ResetCause},
    image::Image,
    network::{AdapterId, Network, Recording},
};
use lss_slave::{BitRate, Settings};

use testkit::{
    frames,
    image_rig::{SETTINGS_OFFSET, bit_per_s, flash_with, on_the_wire},
};

use crate::boards;

/// How long an answer may take, beside two frames.
const PATIENCE: Time = Time::from_ms(5);
/// More bits than a request and its answer have.
const EXCHANGE_BITS: u64 = 300;
/// How long a node may need to come to the bus, or to another rate.
pub const AWAY: Time = Time::from_s(3);
/// From one question to a node that may be away to the next.
const POLL: Time = Time::from_ms(20);

/// What boards are made of.
pub struct Rig<'a> {
    pub image: &'a Image,
    pub part: Part,
    pub settings: board::Settings,
}

/// Boards and a master.
pub struct Bus {
    pub network: Network,
    pub master: AdapterId,
    rate: BitRate,
    /// Resets that were asked for, power-ons included, of each board.
    pub resets: Vec<Vec<ResetCause>>,
}

impl Rig<'_> {
    /// The board of this number, with these settings stored or none.
    pub fn board(&self, number: usize, stored: Option<Settings>) -> Board {
        let settings = board::Settings { unique_id: boards::unique_id(number), ..self.settings };
        let mut board = Board::new(self.part, self.image, settings);
        if let Some(stored) = stored {
            board.set_flash(SETTINGS_OFFSET, &flash_with(&[stored]));
        }
        board
    }

    /// These boards, just switched on, and the master at `rate`.
    pub fn bus(&self, rate: BitRate, boards: impl IntoIterator<Item = Board>) -> Bus {
        let mut network = Network::new();
        network.record(Recording::Off);
        let master = network.add_adapter(Adapter::new(bit_per_s(rate)));
        let count = boards.into_iter().map(|board| network.add_board(board)).count();
        Bus { network, master, rate, resets: vec![vec![ResetCause::PowerOn]; count] }
    }
}

/// A request of the LSS master, or an answer: the missing bytes are 0.
pub fn lss(cob_id: u16, text: &str) -> Frame {
    let mut bytes = frames::bytes(text);
    bytes.resize(8, 0);
    Frame::data(Id::Standard(cob_id), &bytes)
}

/// A frame that text names in full, such as `704: 00`.
fn named(text: &str) -> Frame {
    match text.split_once(": ") {
        None => lss(0x7E4, text),
        Some((cob_id, bytes)) => {
            let cob_id = u16::from_str_radix(cob_id, 16).expect("a COB-ID");
            Frame::data(Id::Standard(cob_id), &frames::bytes(bytes))
        }
    }
}

impl Bus {
    pub fn send(&mut self, request: &str) {
        self.network.send(self.master, lss(0x7E5, request));
    }

    /// Sends an NMT command.
    pub fn command(&mut self, command: &str) {
        self.network.send(self.master, on_the_wire(&frames::command(command)));
    }

    pub fn run_ms(&mut self, span: u64) {
        self.network.run_for(Time::from_ms(span));
    }

    /// The first LSS answer, or none in time.
    fn answer(&mut self, request: &str) -> Option<Frame> {
        while self.network.receive(self.master).is_some() {}
        self.send(request);
        let exchange =
            Time::from_ps(EXCHANGE_BITS * 1_000_000_000_000 / u64::from(bit_per_s(self.rate)));
        let until = self.network.now() + PATIENCE + exchange;
        loop {
            let left = until.saturating_sub(self.network.now());
            let (_, frame) = self.network.run_until_received(self.master, left)?;
            if frame.id == Id::Standard(0x7E4) {
                return Some(frame);
            }
        }
    }

    /// Whether a request is answered at all.
    pub fn is_answered(&mut self, request: &str) -> bool {
        self.answer(request).is_some()
    }

    /// Sends a request that is to be answered so.
    pub fn ask(&mut self, request: &str, expected: &str) -> anyhow::Result<()> {
        match self.answer(request) {
            Some(frame) => {
                ensure!(frame == named(expected), "{request}: answer {frame}, not {expected}")
            }
            None => bail!("{request}: no answer"),
        }
        Ok(())
    }

    /// The number in the answer to an inquiry.
    pub fn inquire(&mut self, request: &str) -> anyhow::Result<u32> {
        let frame = self.answer(request).with_context(|| format!("{request}: no answer"))?;
        Ok(u32::from_le_bytes(*frame.data[1..].first_chunk().expect("eight bytes")))
    }

    /// Sends a request every 20 ms until it is answered so; returns how long it took.
    pub fn reach(&mut self, request: &str, expected: &str, limit: Time) -> anyhow::Result<Time> {
        let begin = self.network.now();
        while self.network.now() < begin + limit {
            if self.network.adapter_mut(self.master).unsent() == 0 {
                self.send(request);
            }
            self.network.run_for(POLL);
            while let Some((time, frame)) = self.network.receive(self.master) {
                if frame == named(expected) {
                    self.run_ms(50);
                    return Ok(time.saturating_sub(begin));
                }
            }
        }
        bail!("{request}: not answered in {} ms", limit.as_ms())
    }

    /// Waits for a frame that a node sends by itself.
    pub fn hear(&mut self, expected: &str, limit: Time) -> anyhow::Result<()> {
        let until = self.network.now() + limit;
        loop {
            let left = until.saturating_sub(self.network.now());
            match self.network.run_until_received(self.master, left) {
                Some((_, frame)) if frame == named(expected) => return Ok(()),
                Some(_) => {}
                None => bail!("{expected} does not come in {} ms", limit.as_ms()),
            }
        }
    }

    pub fn set_master_rate(&mut self, rate: BitRate) {
        self.rate = rate;
        self.network.adapter_mut(self.master).set_bit_rate(bit_per_s(rate));
    }

    /// Gives a board its supply back.
    pub fn power_on(&mut self, board: usize) {
        self.network.power_on(board);
        self.resets[board].push(ResetCause::PowerOn);
    }

    /// The end: no board did what a chip would not have forgiven, or was reset without need.
    pub fn check(&self) -> anyhow::Result<()> {
        for (number, (board, expected)) in
            self.network.boards().iter().zip(&self.resets).enumerate()
        {
            if let Some(finding) = board.findings().first() {
                bail!("board {number}: {finding}");
            }
            ensure!(board.lockup().is_none(), "board {number} is locked up");
            let causes: Vec<_> = board.resets().iter().map(|&(_, cause)| cause).collect();
            ensure!(causes == *expected, "board {number}: resets {:?}", board.resets());
        }
        Ok(())
    }
}
