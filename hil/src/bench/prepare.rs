//! The stored settings of the boards, learned before the sessions change them.

use canopen_node::{BitRate, BitRateSetting, NodeId};

use super::{BOOT, Bench, RESET_NODE, SEARCH};
use crate::{
    board::{self, Board, Original},
    stop::Stop,
};

/// The node-ID of a board that has none, during the sessions; further ones count down.
const FIRST_FREE_ID: u8 = 0x7E;

impl Bench {
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
        let mut ids = (1..=FIRST_FREE_ID).rev().filter_map(NodeId::new);
        ids.find(is_free).unwrap_or(NodeId::new(FIRST_FREE_ID).expect("1..=127"))
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
}
