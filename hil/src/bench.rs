//! What the sessions share: the bus, the boards on it, and the report.

mod prepare;
mod restore;

use std::time::{Duration, Instant};

use canopen_node::{
    BitRate,
    lss::{Address, Request},
};

use crate::{
    adapter::Received,
    board::{self, Board},
    bus::Bus,
    person::Person,
    probe::Probe,
    report::Report,
    sdo,
    stop::Stop,
};

/// NMT commands (CiA 301).
pub const START: u8 = 1;
pub const STOP: u8 = 2;
pub const PRE_OPERATIONAL: u8 = 128;
pub const RESET_NODE: u8 = 129;
pub const RESET_COMMUNICATION: u8 = 130;

/// The time from a reset to the boot-up: the settings' flash may have to be erased.
pub const BOOT: Duration = Duration::from_millis(1500);
/// The wait for a board that looks for the bit rate or has lost its home rate.
pub const SEARCH: Duration = Duration::from_secs(12);

/// The bench with its boards.
pub struct Bench {
    pub bus: Bus,
    pub report: Report,
    pub person: Person,
    pub probe: Option<Probe>,
    pub is_quick: bool,
    /// The boards; empty until their stored settings are known.
    pub boards: Vec<Board>,
    /// The boards whose identity is known.
    pub addresses: Vec<Address>,
    /// The bit rate between the sessions, which all boards have stored.
    pub base: BitRate,
    /// Whether the stored settings of a board may differ from the original ones.
    is_changed: bool,
}

impl Bench {
    pub fn new(
        bus: Bus,
        report: Report,
        person: Person,
        probe: Option<Probe>,
        is_quick: bool,
    ) -> Self {
        let base = bus.rate();
        Self {
            bus,
            report,
            person,
            probe,
            is_quick,
            boards: Vec::new(),
            addresses: Vec::new(),
            base,
            is_changed: false,
        }
    }

    /// The nodes that send a boot-up within `span`; stops listening when all boards have.
    pub fn boot_ups(&mut self, span: Duration) -> Result<Vec<u8>, Stop> {
        let until = Instant::now() + span;
        let mut nodes = Vec::new();
        while let Some(Received { frame, .. }) = self.bus.receive(until)? {
            if matches!((frame.cob_id(), frame.data()), (0x701..=0x77F, [0])) {
                nodes.push((frame.cob_id() & 0x7F) as u8);
            }
            if !self.boards.is_empty()
                && self.boards.iter().all(|board| nodes.contains(&board.id.get()))
            {
                break;
            }
        }
        Ok(nodes)
    }

    /// Restarts all boards and waits for their boot-ups; returns whether all came.
    pub fn restart(&mut self) -> Result<bool, Stop> {
        self.bus.nmt(RESET_NODE, 0)?;
        let nodes = self.boot_ups(BOOT)?;
        Ok(self.boards.iter().all(|board| nodes.contains(&board.id.get())))
    }

    /// Selects a board that may still look for the bit rate; false after `limit`.
    pub fn reach(&mut self, address: Address, limit: Duration) -> Result<bool, Stop> {
        let until = Instant::now() + limit;
        loop {
            if board::is_there(&mut self.bus, address)? && board::select(&mut self.bus, address)? {
                return Ok(true);
            }
            if Instant::now() >= until {
                return Ok(false);
            }
        }
    }

    /// Reads a number by SDO.
    pub fn number(
        &mut self,
        board: Board,
        index: u16,
        sub_index: u8,
    ) -> Result<Result<u32, sdo::Failure>, Stop> {
        sdo::read_number(&mut self.bus, board.id.get(), index, sub_index)
    }

    /// Sends a request; a check of its answer. `expected` is the answer's bytes, or empty for silence.
    pub fn check_answer(
        &mut self,
        what: &str,
        request: [u8; 8],
        expected: &[u8],
    ) -> Result<bool, Stop> {
        // What comes now belongs to earlier requests.
        self.bus.pass(Duration::ZERO)?;
        self.bus.send_to(0x7E5, &request)?;
        let wait = if expected.is_empty() { self.bus.short() } else { self.bus.patience() };
        let answer = self.bus.wait_for(wait, |frame| frame.cob_id() == 0x7E4)?;
        let bytes = answer.as_ref().map(|answer| answer.frame.data());
        let mut padded = expected.to_vec();
        padded.resize(8, 0);
        let is_good = match bytes {
            None => expected.is_empty(),
            Some(bytes) => !expected.is_empty() && bytes == padded,
        };
        let words = |bytes: Option<&[u8]>| bytes.map_or("no answer".to_owned(), board::text);
        let wanted = words(Some(expected).filter(|bytes| !bytes.is_empty()));
        Ok(self.report.expect(what, is_good, words(bytes), wanted))
    }

    /// Asks every board for its node-ID by LSS; returns the boards that do not answer as they must.
    pub fn missing(&mut self) -> Result<Vec<String>, Stop> {
        let mut missing = Vec::new();
        for board in self.boards.clone() {
            let is_selected = board::select(&mut self.bus, board.address)?;
            let id = if is_selected { board::inquire_node_id(&mut self.bus)? } else { None };
            if id != Some(board.id.get()) {
                let id = id.map_or("no answer".to_owned(), |id| format!("node-ID {id:02X}"));
                missing.push(format!("{board}: {id}"));
            }
        }
        self.bus.request(Request::SwitchToWaiting)?;
        Ok(missing)
    }
}
