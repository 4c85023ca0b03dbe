//! What the sessions share: the bus, the boards on it, and the report.

mod prepare;
mod restore;

use std::time::{Duration, Instant};

use canopen_node::{
    BitRate, BitRateSetting, NodeId,
    lss::{Address, Request},
};

use lss_master::{Configure, Identify};

use crate::{
    adapter::Received,
    board::{self, Board, Outcome},
    bus::Bus,
    person::Person,
    product::Product,
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

/// What a server answers that lacks an object or a sub-index.
const MISSING: [&str; 2] = ["abort 06020000", "abort 06090011"];

/// The bench with its boards.
pub struct Bench {
    pub bus: Bus,
    pub product: Product,
    /// The bit rates that the boards let LSS select.
    pub offered: Vec<BitRate>,
    /// Those that the adapter lacks: the boards must not go there.
    pub lacking: Vec<BitRate>,
    /// Whether they also let it select automatic detection.
    pub detects: bool,
    pub report: Report,
    pub person: Person,
    pub is_quick: bool,
    /// The boards; empty until their stored settings are known.
    pub boards: Vec<Board>,
    /// The boards whose identity is known.
    pub addresses: Vec<Address>,
    /// The bit rate between the sessions, which all boards have stored.
    pub base: BitRate,
    /// Whether the stored settings of a board may differ from the original ones.
    pub is_changed: bool,
    /// A board was not found at any bit rate, for longer than the supervision takes.
    pub is_lost: bool,
}

impl Bench {
    /// The nodes that send a boot-up within `span`; stops listening when all boards have.
    pub fn boot_ups(&mut self, span: Duration) -> Result<Vec<u8>, Stop> {
        self.nodes(span, |state| state == 0)
    }

    /// The nodes that send a boot-up or a heartbeat within `span`; stops listening when all boards have.
    pub fn signs_of_life(&mut self, span: Duration) -> Result<Vec<u8>, Stop> {
        self.nodes(span, |_| true)
    }

    fn nodes(&mut self, span: Duration, counts: impl Fn(u8) -> bool) -> Result<Vec<u8>, Stop> {
        let until = Instant::now() + span;
        let mut nodes = Vec::new();
        while let Some(Received { frame, .. }) = self.bus.receive(until)? {
            if matches!((frame.cob_id(), frame.data()), (0x701..=0x77F, [state]) if counts(*state))
            {
                nodes.push((frame.cob_id() & 0x7F) as u8);
            }
            if !self.boards.is_empty() && self.is_each_in(&nodes) {
                break;
            }
        }
        Ok(nodes)
    }

    /// Whether these are the nodes of all boards, and perhaps others.
    pub fn is_each_in(&self, nodes: &[u8]) -> bool {
        self.boards.iter().all(|board| nodes.contains(&board.id.get()))
    }

    /// Restarts all boards and waits for their boot-ups; returns whether all came.
    pub fn restart(&mut self) -> Result<bool, Stop> {
        self.bus.nmt(RESET_NODE, 0)?;
        let nodes = self.boot_ups(BOOT)?;
        Ok(self.is_each_in(&nodes))
    }

    /// Selects a board that may still look for the bit rate; false after `limit`.
    pub fn reach(&mut self, address: Address, limit: Duration) -> Result<bool, Stop> {
        let until = Instant::now() + limit;
        loop {
            if board::is_anyone(&mut self.bus, Identify::address(address))?
                && board::select(&mut self.bus, address)?
            {
                return Ok(true);
            }
            if Instant::now() >= until {
                return Ok(false);
            }
        }
    }

    /// The active node-ID of a board that may still look for the bit rate, as in the frame.
    pub fn reached_node_id(&mut self, address: Address) -> Result<Option<u8>, Stop> {
        if self.reach(address, SEARCH)? { board::node_id(&mut self.bus, address) } else { Ok(None) }
    }

    /// Whether boards and adapter can go to a bit rate.
    pub fn can_go(&self, rate: BitRate) -> bool {
        self.offered.contains(&rate) && !self.lacking.contains(&rate)
    }

    /// A node-ID that no board has.
    pub fn free_id(&self) -> NodeId {
        let is_free = |id: &NodeId| self.boards.iter().all(|board| board.id != *id);
        let mut ids = (1..=127).filter_map(NodeId::new);
        ids.find(is_free).expect("fewer than 127 boards")
    }

    /// Reads a number by SDO.
    pub fn number(&mut self, board: Board, index: u16, sub_index: u8) -> Outcome<u32> {
        let number = sdo::read_number(&mut self.bus, board.id.get(), index, sub_index)?;
        Ok(number.map_err(|why| why.short()))
    }

    /// Reads a number by SDO, in words.
    pub fn shown(
        &mut self,
        board: Board,
        (index, sub_index): (u16, u8),
        words: impl Fn(u32) -> String,
    ) -> Result<String, Stop> {
        Ok(self.number(board, index, sub_index)?.map_or_else(|failure| failure, words))
    }

    /// Whether the boards of another product have no such object; then a check is skipped with that reason.
    pub fn skips(
        &mut self,
        board: Board,
        what: &str,
        (index, sub_index): (u16, u8),
    ) -> Result<bool, Stop> {
        if self.product.is_ours {
            return Ok(false);
        }
        let failure = self.number(board, index, sub_index)?.err();
        let is_missing = failure.is_some_and(|why| MISSING.contains(&&*why));
        if is_missing {
            let why = format!("the product has no {index:04X}h sub {sub_index}");
            self.report.not_tried(format!("{board}: {what}"), why);
        }
        Ok(is_missing)
    }

    /// Gives all boards another heartbeat time, which is not stored.
    pub fn set_heartbeats(&mut self, milliseconds: u16) -> Result<(), Stop> {
        for board in self.boards.clone() {
            let _ = self.set_heartbeat(board.id.get(), milliseconds)?;
        }
        Ok(())
    }

    /// The same for one node.
    pub fn set_heartbeat(&mut self, node: u8, milliseconds: u16) -> Outcome<()> {
        let written = sdo::write(&mut self.bus, node, (0x1017, 0), milliseconds.into(), 2)?;
        Ok(written.map_err(|why| why.short()))
    }

    /// Stores a bit rate on boards; a refusal is a failed check.
    pub fn store(
        &mut self,
        what: &str,
        boards: &[Board],
        rate: BitRateSetting,
    ) -> Result<bool, Stop> {
        for board in boards {
            let configure = Configure::node_id(Some(board.id)).with_bit_rate(rate);
            if let Err(why) = board::store(&mut self.bus, board.address, configure)? {
                self.report.failed(what, format!("{board}: {why}"), "11 00, 13 00, 17 00");
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Sends a request; a check of its answer. `expected` is the answer's bytes, or empty for silence. Both are padded
    /// to eight bytes.
    pub fn check_answer(
        &mut self,
        what: &str,
        request: &[u8],
        expected: &[u8],
    ) -> Result<(), Stop> {
        let padded = |bytes: &[u8]| {
            let mut bytes = bytes.to_vec();
            bytes.resize(8, 0);
            bytes
        };
        // What comes now belongs to earlier requests.
        self.bus.pass(Duration::ZERO)?;
        self.bus.send_to(0x7E5, &padded(request))?;
        let wait = if expected.is_empty() { self.bus.short() } else { self.bus.patience() };
        let answer = self.bus.wait_for(wait, |frame| frame.cob_id() == 0x7E4)?;
        let is_good = match &answer {
            None => expected.is_empty(),
            Some(answer) => !expected.is_empty() && answer.frame.data() == padded(expected),
        };
        let words = |bytes: Option<&[u8]>| bytes.map_or("no answer".to_owned(), board::text);
        let wanted = words(Some(expected).filter(|bytes| !bytes.is_empty()));
        let seen = words(answer.as_ref().map(|answer| answer.frame.data()));
        self.report.under(service(request)).expect(what, is_good, seen, wanted);
        Ok(())
    }

    /// Waits for the boot-up of a node; a check that it comes.
    pub fn check_boot_up(&mut self, what: &str, id: NodeId, wait: Duration) -> Result<(), Stop> {
        let cob_id = 0x700 + u16::from(id.get());
        let boot_up =
            self.bus.wait_for(wait, |frame| frame.cob_id() == cob_id && frame.data() == [0])?;
        self.report.either(what, boot_up.is_some(), ["a boot-up", "no boot-up"]);
        Ok(())
    }

    /// Asks every board for its node-ID by LSS; returns the boards that do not answer as they must.
    pub fn missing(&mut self) -> Result<Vec<String>, Stop> {
        let mut missing = Vec::new();
        for board in self.boards.clone() {
            let id = board::node_id(&mut self.bus, board.address)?;
            if id != Some(board.id.get()) {
                missing.push(format!("{board}: {}", node_id_text(id)));
            }
        }
        self.bus.request(Request::SwitchToWaiting)?;
        Ok(missing)
    }
}

/// The service of CiA 305 that a request belongs to.
fn service(request: &[u8]) -> &'static str {
    match request {
        [0x04, ..] => "CiA 305, switch state global",
        [0x11, ..] => "CiA 305, configure node-ID",
        [0x13, ..] => "CiA 305, configure bit timing parameters",
        [0x17, ..] => "CiA 305, store configuration",
        [0x40..=0x43, ..] => "CiA 305, switch state selective",
        [0x46..=0x4B, ..] => "CiA 305, identify remote slave",
        [0x4C, ..] => "CiA 305, identify non-configured remote slave",
        [0x51, ..] => "CiA 305, Fastscan",
        [0x5A..=0x5D, ..] => "CiA 305, inquire identity",
        [0x5E, ..] => "CiA 305, inquire node-ID",
        _ => "CiA 305, LSS protocols",
    }
}

/// A node-ID as in the frame; `None`: there was no answer.
fn node_id_text(id: Option<u8>) -> String {
    id.map_or("no answer".to_owned(), |id| format!("node-ID {id:02X}"))
}
