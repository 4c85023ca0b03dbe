//! Boards of one reading and an LSS master on one bus, with errors where a test would panic.

use anyhow::{Context, bail, ensure};
use emulator::{
    Time,
    board::{self, Board},
    can::{Adapter, Frame, Id},
    chip::{Part, ResetCause},
    image::Image,
    network::{AdapterId, Network, Recording},
};
use lss_master::{Master, Procedure};
use lss_slave::{BitRate, Settings};

use testkit::{
    boards, frames,
    image_rig::{SETTINGS_OFFSET, bit_per_s, flash_with, on_the_wire},
    lss_session,
};

/// The time allowed for an answer, besides two frames.
const PATIENCE: Time = Time::from_ms(5);
/// An upper limit for the bits of a request and its answer.
const EXCHANGE_BITS: u64 = 300;
/// The time that a node may need to join the bus, or to change to another rate.
pub const AWAY: Time = Time::from_s(3);
/// The interval between questions to a node that may be away.
const POLL: Time = Time::from_ms(20);

/// A board to be emulated: its chip and crystal, and the reading of the manuals.
pub struct Variant<'a> {
    pub image: &'a Image,
    pub part: Part,
    pub settings: board::Settings,
}

/// Boards and a master on one bus.
pub struct Bus {
    pub network: Network,
    pub master: AdapterId,
    rate: BitRate,
    lss: Master,
    /// The expected resets of each board, including power-ons.
    pub resets: Vec<Vec<ResetCause>>,
}

impl Variant<'_> {
    /// The board with this number, with the given settings stored or none.
    pub fn board(&self, number: usize, stored: Option<Settings>) -> Board {
        let settings = board::Settings { unique_id: boards::unique_id(number), ..self.settings };
        let mut board = Board::new(self.part, self.image, settings);
        if let Some(stored) = stored {
            board.set_flash(SETTINGS_OFFSET, &flash_with(&[stored]));
        }
        board
    }

    /// A bus with these boards, just switched on, and the master at `rate`.
    pub fn bus(&self, rate: BitRate, boards: impl IntoIterator<Item = Board>) -> Bus {
        let mut network = Network::new();
        network.record(Recording::Off);
        let master = network.add_adapter(Adapter::new(bit_per_s(rate)));
        let count = boards.into_iter().map(|board| network.add_board(board)).count();
        let lss = Master::new(lss_session::timing(rate));
        Bus { network, master, rate, lss, resets: vec![vec![ResetCause::PowerOn]; count] }
    }
}

fn of_node(text: &str) -> Frame {
    on_the_wire(&frames::of_node(text))
}

impl Bus {
    /// Sends a frame of the master.
    pub fn send(&mut self, request: &str) {
        self.network.send(self.master, on_the_wire(&frames::of_master(request)));
    }

    pub fn run_ms(&mut self, span: u64) {
        self.network.run_for(Time::from_ms(span));
    }

    /// The first LSS answer, or `None` after the time-out.
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

    /// Carries out a procedure of the LSS master.
    pub fn carry_out<P: Procedure>(&mut self, procedure: P) -> anyhow::Result<P::Output> {
        Ok(lss_session::carry_out(&mut self.network, self.master, &mut self.lss, procedure)?)
    }

    /// Whether a request is answered at all.
    pub fn is_answered(&mut self, request: &str) -> bool {
        self.answer(request).is_some()
    }

    /// Sends a request and checks its answer.
    pub fn ask(&mut self, request: &str, expected: &str) -> anyhow::Result<()> {
        match self.answer(request) {
            Some(frame) => {
                ensure!(frame == of_node(expected), "{request}: answer {frame}, not {expected}")
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

    /// Sends a request every 20 ms until the answer is as expected; returns the time taken.
    pub fn reach(&mut self, request: &str, expected: &str, limit: Time) -> anyhow::Result<Time> {
        let begin = self.network.now();
        while self.network.now() < begin + limit {
            if self.network.adapter_mut(self.master).unsent() == 0 {
                self.send(request);
            }
            self.network.run_for(POLL);
            while let Some((time, frame)) = self.network.receive(self.master) {
                if frame == of_node(expected) {
                    self.run_ms(50);
                    return Ok(time.saturating_sub(begin));
                }
            }
        }
        bail!("{request}: not answered in {} ms", limit.as_ms())
    }

    /// Waits for a frame that a node sends unasked.
    pub fn hear(&mut self, expected: &str, limit: Time) -> anyhow::Result<()> {
        let until = self.network.now() + limit;
        loop {
            let left = until.saturating_sub(self.network.now());
            match self.network.run_until_received(self.master, left) {
                Some((_, frame)) if frame == of_node(expected) => return Ok(()),
                Some(_) => {}
                None => bail!("{expected} is not received in {} ms", limit.as_ms()),
            }
        }
    }

    pub fn set_master_rate(&mut self, rate: BitRate) {
        self.rate = rate;
        self.lss = Master::new(lss_session::timing(rate));
        self.network.adapter_mut(self.master).set_bit_rate(bit_per_s(rate));
    }

    /// Switches a board's supply on.
    pub fn power_on(&mut self, board: usize) {
        self.network.power_on(board);
        self.resets[board].push(ResetCause::PowerOn);
    }

    /// Final check: no board made an access that a real chip does not tolerate, or was reset unexpectedly.
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
