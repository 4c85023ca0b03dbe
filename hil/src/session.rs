//! What the sessions share: the bus, the boards on it, the report, and the way back to a known state.

use std::time::{Duration, Instant};

use lss_slave::{
    BitRate, BitRateSetting, NodeId,
    lss::{Address, Request},
};

use crate::{
    adapter::Received,
    board::{self, Board, Original},
    bus::Bus,
    person::Person,
    probe::Probe,
    report::{Left, Report},
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
/// The node-ID of a board that has none, during the sessions; further ones count down.
const FIRST_FREE_ID: u8 = 0x7E;
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

    /// Learns what the boards have stored, gives those without a node-ID one, and stores the rate of the bench.
    pub fn prepare(&mut self) -> Result<(), Stop> {
        self.base = self.bus.rate();
        let states = self.bus.states.clone();
        self.bus.nmt(RESET_NODE, 0)?;
        self.boot_ups(BOOT)?;
        let mut boards = Vec::new();
        for address in self.addresses.clone() {
            let stored = match self.reach(address, SEARCH)? {
                true => board::inquire_node_id(&mut self.bus)?,
                false => None,
            };
            let Some(stored) = stored else {
                return Err(Stop::Bench(format!(
                    "board {:08X} answered before a reset, but not after it, at {} kbit/s. It may have stored another \
                     bit rate: run `cargo hil` again",
                    address.serial_number,
                    self.base.kbit_per_s()
                )));
            };
            let node_id = NodeId::from_lss(stored).unwrap_or(None);
            let original = Original {
                node_id,
                bit_rate: self.base.into(),
                heartbeat_ms: 0,
                was_operational: node_id.is_some_and(|id| states.get(&id.get()) == Some(&5)),
            };
            boards.push(Board { address, id: node_id.unwrap_or(self.free_id(&boards)), original });
        }

        // Only a node-ID is stored: the stored bit rate shows at a boot-up.
        self.boards = boards;
        self.is_changed = true;
        for board in self.boards.clone() {
            if board.original.node_id.is_none() {
                self.select_or_stop(&board)?;
                self.store_or_stop(&board, Some(board.id), None)?;
            }
        }
        let detecting = self.detecting()?;
        for at in 0..self.boards.len() {
            let board = self.boards[at];
            let id = match self.reach(board.address, SEARCH)? {
                true => board::inquire_node_id(&mut self.bus)?,
                false => None,
            };
            if id != Some(board.id.get()) {
                let id = id.map_or("unknown".to_owned(), |id| format!("{id:02X}"));
                return Err(Stop::Bench(format!(
                    "{board} does not store: node-ID {:02X} was acknowledged by 17 00, and after a reset it is {id}",
                    board.id.get()
                )));
            }
            let home = self.number(board, 0x2000, 5)?.ok();
            let home = BitRate::ALL.into_iter().find(|rate| Some(rate.kbit_per_s().into()) == home);
            let Some(home) = home else {
                return Err(Stop::Bench(format!(
                    "{board} does not report its home bit rate (2000h sub 5)"
                )));
            };
            let original = &mut self.boards[at].original;
            original.bit_rate = match detecting.contains(&board.id) {
                true => BitRateSetting::Automatic,
                false => home.into(),
            };
            if let Ok(heartbeat) = self.number(board, 0x1017, 0)? {
                self.boards[at].original.heartbeat_ms = heartbeat as u16;
            }
            self.select_or_stop(&board)?;
            self.store_or_stop(&board, Some(board.id), Some(self.base.into()))?;
            let Board { original, .. } = self.boards[at];
            self.report.board(format!(
                "{board}: {original} stored, heartbeat {} ms",
                original.heartbeat_ms
            ));
        }
        self.restart()?;
        Ok(())
    }

    /// The boards that detect the bit rate. After a reset such a board is silent until it hears a frame; others send
    /// their boot-up at once. One heard boot-up is proof, silence is doubted once.
    fn detecting(&mut self) -> Result<Vec<NodeId>, Stop> {
        let mut silent: Vec<_> = self.boards.iter().map(|board| board.id).collect();
        for _ in 0..2 {
            if !silent.is_empty() {
                // A board that still detects the rate would send its boot-up at the reset command.
                for address in self.addresses.clone() {
                    self.reach(address, SEARCH)?;
                }
                self.bus.nmt(RESET_NODE, 0)?;
                let heard = self.boot_ups(BOOT)?;
                silent.retain(|id| !heard.contains(&id.get()));
            }
        }
        Ok(silent)
    }

    fn free_id(&self, taken: &[Board]) -> NodeId {
        let is_free = |id: &NodeId| {
            !self.bus.states.contains_key(&id.get()) && taken.iter().all(|board| board.id != *id)
        };
        let ids = (1..=FIRST_FREE_ID).rev().filter_map(NodeId::new);
        ids.filter(is_free).next().unwrap_or(NodeId::new(FIRST_FREE_ID).expect("1..=127"))
    }

    fn select_or_stop(&mut self, board: &Board) -> Result<(), Stop> {
        match board::select(&mut self.bus, board.address)? {
            true => Ok(()),
            false => Err(Stop::Bench(format!("{board} does not answer 43"))),
        }
    }

    fn store_or_stop(
        &mut self,
        board: &Board,
        node_id: Option<NodeId>,
        rate: Option<BitRateSetting>,
    ) -> Result<(), Stop> {
        let stored = board::store(&mut self.bus, node_id, rate)?;
        stored.map_err(|why| Stop::Bench(format!("{board} does not store its settings: {why}")))
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

    /// Brings all boards back to their node-IDs at the base rate, as each session finds them.
    pub fn settle(&mut self) -> Result<(), Stop> {
        if self.bus.rate() != self.base {
            self.bus.open(self.base)?;
        }
        if self.missing()?.is_empty() {
            return Ok(());
        }
        self.report.progress("bringing the boards back");
        let wanted: Vec<_> =
            self.boards.iter().map(|board| (*board, Some(board.id), self.base.into())).collect();
        let lost = self.store_everywhere(&wanted)?;
        self.bus.open(self.base)?;
        self.restart()?;
        match lost.is_empty() && self.missing()?.is_empty() {
            true => Ok(()),
            false => Err(Stop::Bench(format!(
                "the boards cannot be brought back to {} kbit/s: {}",
                self.base.kbit_per_s(),
                lost.join("; ")
            ))),
        }
    }

    /// Finds each board at whatever rate it has, and stores these settings. Returns what failed.
    fn store_everywhere(
        &mut self,
        wanted: &[(Board, Option<NodeId>, BitRateSetting)],
    ) -> Result<Vec<String>, Stop> {
        let mut rest = wanted.to_vec();
        let mut refusals = Vec::new();
        for attempt in 0..3 {
            for rate in board::rates_from(self.bus.rate()) {
                if rest.is_empty() {
                    return Ok(refusals);
                }
                if self.bus.fixed_rate().is_some_and(|fixed| fixed != rate) {
                    continue;
                }
                self.bus.open(rate)?;
                let mut still = Vec::new();
                for (board, node_id, setting) in rest {
                    let is_found = board::is_there(&mut self.bus, board.address)?
                        && board::select(&mut self.bus, board.address)?;
                    if !is_found {
                        still.push((board, node_id, setting));
                        continue;
                    }
                    if let Err(why) = board::store(&mut self.bus, node_id, Some(setting))? {
                        refusals.push(format!("{board}: {why}"));
                    }
                }
                rest = still;
                if !rest.is_empty() && attempt == 1 {
                    // A board that answers nothing may still listen, and return to its stored rate.
                    self.bus.nmt(RESET_NODE, 0)?;
                    self.bus.pass(Duration::from_millis(100))?;
                }
            }
        }
        refusals.extend(rest.iter().map(|(board, ..)| format!("{board} answers at no bit rate")));
        Ok(refusals)
    }

    /// Stores the original settings again, after whatever has happened.
    pub fn restore(&mut self) {
        if !self.is_changed {
            self.bus.leave();
            return;
        }
        println!("restoring the boards");
        self.bus.insist();
        let outcome = self.try_restore();
        self.bus.leave();
        self.report.left = match outcome {
            Ok(faults) if faults.is_empty() => Left::Restored,
            Ok(faults) => Left::Changed(format!("{}. {}", faults.join("; "), self.advice())),
            Err(stop) => Left::Changed(format!("{stop}. {}", self.advice())),
        };
    }

    fn advice(&self) -> String {
        let originals: Vec<_> =
            self.boards.iter().map(|board| format!("{board}: {}", board.original)).collect();
        format!("The settings were, {}", originals.join("; "))
    }

    fn try_restore(&mut self) -> Result<Vec<String>, Stop> {
        self.reopen()?;
        let wanted: Vec<_> = self
            .boards
            .iter()
            .map(|board| (*board, board.original.node_id, board.original.bit_rate))
            .collect();
        let mut faults = self.store_everywhere(&wanted)?;
        self.bus.nmt(RESET_NODE, 0)?;
        self.bus.pass(Duration::from_millis(200))?;
        for board in self.boards.clone() {
            let Original { node_id, bit_rate, heartbeat_ms, was_operational } = board.original;
            if let BitRateSetting::Fixed(rate) = bit_rate
                && self.bus.fixed_rate().is_none()
            {
                self.bus.open(rate)?;
            }
            let is_there = self.reach(board.address, SEARCH)?;
            let id = if is_there { board::inquire_node_id(&mut self.bus)? } else { None };
            self.bus.request(Request::SwitchToWaiting)?;
            if id != Some(NodeId::to_lss(node_id)) {
                let id = id.map_or("no answer".to_owned(), |id| format!("node-ID {id:02X}"));
                faults.push(format!("{board} after its restart: {id}"));
                continue;
            }
            let Some(node_id) = node_id else { continue };
            let present = sdo::read_number(&mut self.bus, node_id.get(), 0x1017, 0)?;
            if present != Ok(heartbeat_ms.into()) {
                faults.extend(self.store_heartbeat(node_id.get(), heartbeat_ms)?.err());
            }
            if was_operational {
                self.bus.nmt(START, node_id.get())?;
            }
        }
        Ok(faults)
    }

    /// Writes the heartbeat time and stores it by 1010h.
    pub fn store_heartbeat(
        &mut self,
        node: u8,
        milliseconds: u16,
    ) -> Result<Result<(), String>, Stop> {
        const SAVE: u32 = u32::from_le_bytes(*b"save");
        let written = sdo::write(&mut self.bus, node, (0x1017, 0), milliseconds.into(), 2)?;
        let saved = sdo::write(&mut self.bus, node, (0x1010, 1), SAVE, 4)?;
        Ok(written.and(saved).map_err(|failure| format!("heartbeat time: {failure}")))
    }

    /// Connects to the adapter again if it has vanished, as a USB plug that was pulled and put back does.
    fn reopen(&mut self) -> Result<(), Stop> {
        const LIMIT: Duration = Duration::from_secs(10);
        let until = Instant::now() + LIMIT;
        loop {
            match self.bus.open(self.bus.rate()) {
                Err(Stop::NoAdapter(_) | Stop::AdapterGone(_)) if Instant::now() < until => {
                    std::thread::sleep(Duration::from_millis(500));
                    self.bus.check_interrupt()?;
                }
                outcome => return outcome,
            }
        }
    }
}
