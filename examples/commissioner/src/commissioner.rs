//! The commissioner: asks the boards of its table, gives them their node-IDs, and looks for new ones.

use core::mem;

use canopen_node::{
    Frame, NodeId,
    lss::{Address, Request},
    nmt,
};
use canopen_stm32f4::now;
use lss_master::{
    Bus, Error, Fastscan, InquireNodeId, Master, Procedure, SelectAlone, Timing, run,
};

use crate::{
    network::{Network, Rival},
    table::{BOARDS, Table},
};

/// The time between two rounds, in microseconds as all times.
const PERIOD: u32 = 10_000_000;
/// The time for boards to come to the bus together, and for a node to send a heartbeat.
const SETTLE: u32 = 1_000_000;
const LISTEN: u32 = 1_500_000;
/// How long a rival must be silent.
const QUIET: u32 = 2_000_000;
/// For slaves that look for frames once in 10 ms.
pub const TIMING: Timing = Timing { answer: 100_000, store: 1_000_000, margin: 10_000, gap: 0 };

/// What the LED says.
#[derive(Clone, Copy, PartialEq, Eq)]
#[repr(u16)]
enum State {
    /// On: all boards of the table are at their places.
    Complete = 0xFFFF,
    /// Flickers: it has not asked yet, has just taken a board, asks again, or another master is at work.
    Waiting = 0x3333,
    /// One flash: a board of the table is missing.
    Missing = 0x0001,
    /// Blinks: there is a new board.
    New = 0x00FF,
    /// Two flashes: a board cannot have its node-ID.
    Conflict = 0x0005,
    /// Three flashes: the table is not valid, or was not stored.
    Invalid = 0x0015,
}

/// Who answers to an address.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Answer {
    Nobody,
    /// A board with this node-ID.
    One(Option<NodeId>),
    Two,
}

pub struct Commissioner {
    pub network: Network,
    pub table: Table,
    pub master: Master,
    /// The last round had a conflict.
    pub has_conflict: bool,
}

impl Commissioner {
    pub fn commission(mut self) -> ! {
        let mut state = State::Waiting;
        loop {
            self.rest(state);
            state = self.round().unwrap_or(State::Waiting);
        }
    }

    /// Waits for the next round: until the button is pressed, a second after a boot-up, and 10 s at most. A rival makes a
    /// press void.
    fn rest(&mut self, mut state: State) {
        let mut until = now().plus_micros(if state == State::Waiting { SETTLE } else { PERIOD });
        loop {
            let seen = &mut self.network.seen;
            if mem::take(&mut seen.rival) {
                (seen.press, state, until) = (false, State::Waiting, now().plus_micros(QUIET));
            } else if until.has_come(now()) || seen.press && state != State::Waiting {
                return;
            } else if mem::take(&mut seen.boot_up) && state != State::Waiting {
                until = until.earlier(now().plus_micros(SETTLE));
            }
            seen.pattern = state as u16;
            let _ = self.network.pause(10_000);
        }
    }

    /// Asks the boards of the table, gives those their node-IDs that have another or none, and looks for a new one, which
    /// the button takes.
    fn round(&mut self) -> Result<State, Rival> {
        let is_pressed = mem::take(&mut self.network.seen.press);
        if !self.table.is_valid {
            return Ok(State::Invalid);
        }
        let mut answers = [Answer::Nobody; BOARDS + 1];
        for (node, board) in self.table.boards() {
            answers[at(node)] = self.ask(board)?;
        }
        let is_astray = |row: &(NodeId, Address)| match answers[at(row.0)] {
            Answer::One(node) => node != Some(row.0),
            _ => false,
        };
        let mut has_conflict = answers.contains(&Answer::Two);
        if self.table.boards().any(|row| is_astray(&row)) {
            for (node, board) in self.table.boards().filter(is_astray) {
                // Boards with the node-IDs of one another give them back first.
                if answers.contains(&Answer::One(Some(node))) {
                    self.give(board, None)?;
                }
            }
            self.network.seen.nodes = 0;
            self.network.pause(LISTEN)?;
        }
        for (node, board) in self.table.boards().filter(is_astray) {
            has_conflict |= self.network.is_taken(node)? || !self.give(board, Some(node))?;
        }
        let found = self.run(Fastscan::new())?.ok().flatten();
        // One of the table has come late, or cannot have its node-ID.
        let new = found.filter(|found| self.table.boards().all(|(_, board)| board != *found));
        self.run(Request::SwitchToWaiting)?.ok();
        let is_missing = |(node, _)| answers[at(node)] == Answer::Nobody;
        let is_confirmed = mem::replace(&mut self.has_conflict, has_conflict);
        Ok(match new {
            Some(new) if is_pressed => self.take(new, &answers)?,
            _ if has_conflict && is_confirmed => State::Conflict,
            // It may be a board that has just lost its power, without a node-ID and so without a boot-up.
            _ if has_conflict => State::Waiting,
            Some(_) => State::New,
            None if self.table.boards().any(is_missing) => State::Missing,
            None => State::Complete,
        })
    }

    /// Writes a new board into the row of the only lost board of its product, or else into the first free one. The next
    /// round gives it its node-ID.
    fn take(&mut self, new: Address, answers: &[Answer]) -> Result<State, Rival> {
        let product = |board: Address| (board.vendor_id, board.product_code);
        let is_lost = |(node, board): &(NodeId, Address)| {
            answers[at(*node)] == Answer::Nobody && product(*board) == product(new)
        };
        let mut lost = self.table.boards().filter(is_lost).map(|(node, _)| node);
        let row = match (lost.next(), lost.next()) {
            (None, _) => self.free_row()?,
            (lost, None) => lost,
            _ => None,
        };
        Ok(match (row, self.ask(new)?) {
            (Some(node), Answer::One(None)) if self.table.put(node, new) => State::Waiting,
            (Some(_), Answer::One(None)) => State::Invalid,
            _ => State::Conflict,
        })
    }

    /// The first node-ID that neither the table nor a node on the bus has.
    fn free_row(&mut self) -> Result<Option<NodeId>, Rival> {
        for node in (1..=BOARDS as u8).filter_map(NodeId::new) {
            if self.table.boards().all(|(known, _)| known != node)
                && !self.network.is_taken(node)?
            {
                return Ok(Some(node));
            }
        }
        Ok(None)
    }

    /// Selects the board with this address, and asks for its node-ID.
    fn ask(&mut self, board: Address) -> Result<Answer, Rival> {
        self.network.seen.surplus = 0;
        if self.run(SelectAlone::new(board))?.is_err() {
            return Ok(Answer::Nobody);
        }
        let node = self.run(InquireNodeId)?;
        // A second answer may come yet.
        self.network.pause(10_000)?;
        Ok(match node {
            _ if self.network.seen.surplus > 0 => Answer::Two,
            Ok(node) => Answer::One(node),
            Err(_) => Answer::Nobody,
        })
    }

    /// Gives a board a node-ID, or takes its own; returns whether it has done so.
    fn give(&mut self, board: Address, node: Option<NodeId>) -> Result<bool, Rival> {
        let Answer::One(before) = self.ask(board)? else { return Ok(false) };
        let outcome = self.run(Request::ConfigureNodeId(NodeId::to_lss(node)))?;
        self.run(Request::SwitchToWaiting)?.ok();
        if let (Ok(()), Some(before)) = (outcome, before) {
            let reset_communication = [0x82, before.get(), 0, 0, 0, 0, 0, 0];
            self.network.send(&Frame::with_bytes(nmt::COMMAND_COB_ID, 2, reset_communication))?;
        }
        self.network.pause(50_000)?;
        Ok(self.ask(board)? == Answer::One(node))
    }

    /// Carries out a procedure of the LSS master.
    fn run<P: Procedure>(&mut self, procedure: P) -> Result<Result<P::Output, Error>, Rival> {
        run(&mut self.network, &mut self.master, procedure)
    }
}

/// The place of a node-ID among the answers.
fn at(node: NodeId) -> usize {
    node.get().into()
}
