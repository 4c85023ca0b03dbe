//! The stored settings of the boards, learned before the sessions change them.

use canopen_node::{BitRate, BitRateSetting, NodeId, lss::Request};
use lss_master::Configure;

use super::{BOOT, Bench, RESET_NODE, SEARCH, node_id_text};
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
        let states = self.bus.heard.clone();
        self.bus.nmt(RESET_NODE, 0)?;
        self.boot_ups(BOOT)?;
        let mut boards = Vec::new();
        for address in self.addresses.clone() {
            let Some(stored) = self.reached_node_id(address)? else {
                return Err(Stop::Bench(format!(
                    "board {:08X} answered before a reset, but not after it, at {}. It may have stored another bit \
                     rate: run `cargo hil` again",
                    address.serial_number, self.base
                )));
            };
            let node_id = NodeId::from_lss(stored).unwrap_or(None);
            let original = Original {
                node_id,
                bit_rate: self.base.into(),
                heartbeat_ms: 0,
                was_operational: node_id.is_some_and(|id| states.get(&id.get()) == Some(&Some(5))),
            };
            let id = node_id.unwrap_or_else(|| self.unheard_id(&boards));
            boards.push(Board { address, id, original });
        }

        // Only a node-ID is stored: the stored bit rate shows at a boot-up.
        self.boards = boards;
        self.is_changed = true;
        for board in self.boards.clone() {
            if board.original.node_id.is_none() {
                self.store_or_stop(&board, Configure::node_id(Some(board.id)))?;
            }
        }
        let detecting = self.detecting()?;
        for at in 0..self.boards.len() {
            let board = self.boards[at];
            let id = self.reached_node_id(board.address)?;
            if id != Some(board.id.get()) {
                return Err(Stop::Bench(format!(
                    "{board} does not store: node-ID {:02X} was acknowledged by 17 00, and after a reset there is {}",
                    board.id.get(),
                    node_id_text(id)
                )));
            }
            let home = self.number(board, 0x2000, 5)?.ok();
            let home = BitRate::ALL.into_iter().find(|rate| Some(rate.kbit_per_s().into()) == home);
            // Without that object it is at the rate that it has stored.
            let home = match home {
                None if self.skips(board, "home bit rate", (0x2000, 5))? => self.base,
                None => {
                    return Err(Stop::Bench(format!(
                        "{board} does not report its home bit rate (2000h sub 5)"
                    )));
                }
                Some(home) => home,
            };
            let original = &mut self.boards[at].original;
            // One that is silent since its home is another bit rate does not detect it.
            original.bit_rate = match detecting.contains(&board.id) && home == self.base {
                true => BitRateSetting::Automatic,
                false => home.into(),
            };
            if let Ok(heartbeat) = self.number(board, 0x1017, 0)? {
                self.boards[at].original.heartbeat_ms = heartbeat as u16;
            }
            let configure = Configure::node_id(Some(board.id)).with_bit_rate(self.base.into());
            self.store_or_stop(&board, configure)?;
            let original = self.boards[at].original;
            let heartbeat_ms = original.heartbeat_ms;
            self.report.board(format!("{board}: {original} stored, heartbeat {heartbeat_ms} ms"));
        }
        self.learn_rates()?;
        self.restart()?;
        Ok(())
    }

    /// Learns which bit rates the first board lets LSS select, and which ones the adapter lacks. A reset drops the one that
    /// the board has accepted last.
    fn learn_rates(&mut self) -> Result<(), Stop> {
        if self.bus.fixed_rate().is_none() {
            for rate in BitRate::ALL {
                if Stop::without_rate(self.bus.listen(rate))?.is_none() {
                    self.lacking.push(rate);
                }
            }
            self.bus.open(self.base)?;
        }
        let _ = board::select(&mut self.bus, self.boards[0].address)?;
        let mut accepts = |index| {
            let answer = self.bus.ask(Request::ConfigureBitTiming { table: 0, index })?;
            Ok(matches!(answer, Some([0x13, 0, ..])))
        };
        let mut offered = Vec::new();
        for rate in BitRate::ALL {
            if accepts(rate.index())? {
                offered.push(rate);
            }
        }
        self.detects = accepts(BitRateSetting::Automatic.index())?;
        self.offered = offered;
        self.bus.request(Request::SwitchToWaiting)
    }

    /// The boards that detect the bit rate. After a reset such a board is silent until it hears a frame; others send
    /// their boot-up at once. One heard boot-up is proof; after silence it is asked once more.
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

    /// A node-ID that was not heard on the bus, and that no board has.
    fn unheard_id(&self, taken: &[Board]) -> NodeId {
        let is_free = |id: &NodeId| {
            !self.bus.heard.contains_key(&id.get()) && taken.iter().all(|board| board.id != *id)
        };
        let mut ids = (1..=FIRST_FREE_ID).rev().filter_map(NodeId::new);
        ids.find(is_free).unwrap_or(NodeId::new(FIRST_FREE_ID).expect("1..=127"))
    }

    fn store_or_stop(&mut self, board: &Board, configure: Configure) -> Result<(), Stop> {
        let stored = board::store(&mut self.bus, board.address, configure)?;
        stored.map_err(|why| Stop::Bench(format!("{board} does not store its settings: {why}")))
    }
}
