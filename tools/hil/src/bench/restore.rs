//! The way back: to the base rate after each session, and to the original settings in the end.

use std::{
    thread,
    time::{Duration, Instant},
};

use canopen_node::{BitRate, BitRateSetting, NodeId, lss::Request};
use lss_master::Configure;

use super::{Bench, RESET_NODE, SEARCH, START, node_id_text};
use crate::{
    board::{self, Board, Original, Outcome},
    report::Left,
    sdo,
    stop::Stop,
};

/// Bits that are longer than the dominant time-out of common transceivers have these rates.
const CUT_OFF: [BitRate; 2] = [BitRate::Kbit20, BitRate::Kbit10];

impl Bench {
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
        let mut lost = self.store_everywhere(&wanted)?;
        self.bus.open(self.base)?;
        self.restart()?;
        lost.extend(self.missing()?);
        if lost.is_empty() {
            return Ok(());
        }
        let why = lost.join("; ");
        Err(Stop::Bench(format!("the boards cannot be brought back to {}: {why}", self.base)))
    }

    /// Finds each board at whatever rate it has, stores these settings, and resets it: a board at another rate is not
    /// reached from the base rate. Returns what failed.
    fn store_everywhere(
        &mut self,
        wanted: &[(Board, Option<NodeId>, BitRateSetting)],
    ) -> Result<Vec<String>, Stop> {
        /// A board at a commanded rate at which it cannot answer goes home after 30 s (docs/reference.md).
        const SUPERVISION: Duration = Duration::from_secs(40);
        let (first, begin) = (self.bus.rate(), Instant::now());
        let mut rest = wanted.to_vec();
        let mut refusals = Vec::new();
        for attempt in 0.. {
            if attempt >= 3 && (self.is_lost || begin.elapsed() > SUPERVISION) {
                break;
            }
            // A board that answers nothing may still listen, and return to its stored rate.
            let resets = attempt % 2 == 1;
            if resets {
                self.reset_unheard()?;
            }
            let search_end = Instant::now() + if resets { SEARCH } else { Duration::ZERO };
            for rate in board::rates_from(first) {
                if rest.is_empty() {
                    return Ok(refusals);
                }
                if self.bus.fixed_rate().is_some_and(|fixed| fixed != rate)
                    || resets && CUT_OFF.contains(&rate)
                {
                    continue;
                }
                if Stop::without_rate(self.bus.open(rate))?.is_none() {
                    continue;
                }
                let (mut still, count) = (Vec::new(), rest.len());
                for (board, node_id, setting) in rest {
                    let limit = search_end.saturating_duration_since(Instant::now());
                    if !self.reach(board.address, limit)? {
                        still.push((board, node_id, setting));
                        continue;
                    }
                    let configure = Configure::node_id(node_id).with_bit_rate(setting);
                    if let Err(why) = self.bus.carry_out(configure)? {
                        refusals.push(format!("{board}: {why}"));
                    }
                }
                rest = still;
                if rest.len() < count || resets {
                    self.bus.nmt(RESET_NODE, 0)?;
                    self.bus.pass(Duration::from_millis(100))?;
                }
            }
        }
        self.is_lost = true;
        refusals.extend(rest.iter().map(|(board, ..)| format!("{board} answers at no bit rate")));
        Ok(refusals)
    }

    /// Resets the boards at the rates at which a transceiver may cut off what they send. A board that hears a request there
    /// tries to answer for ever: it would then hear nothing but NMT commands, whose COB-ID comes first.
    fn reset_unheard(&mut self) -> Result<(), Stop> {
        if self.bus.fixed_rate().is_some() {
            return Ok(());
        }
        for rate in CUT_OFF {
            if Stop::without_rate(self.bus.open(rate))?.is_none() {
                continue;
            }
            // One of them comes between bus-off and the next attempt to answer.
            for _ in 0..5 {
                self.bus.nmt(RESET_NODE, 0)?;
                self.bus.pass(Duration::from_millis(300))?;
            }
        }
        Ok(())
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
        for board in self.boards.clone() {
            let Original { node_id, bit_rate, heartbeat_ms, was_operational } = board.original;
            if let BitRateSetting::Fixed(rate) = bit_rate
                && self.bus.fixed_rate().is_none()
                && Stop::without_rate(self.bus.open(rate))?.is_none()
            {
                let words = "but the adapter lacks it: it was not seen there";
                faults.push(format!("{board} has stored {rate} again, {words}"));
                continue;
            }
            let id = self.reached_node_id(board.address)?;
            self.bus.request(Request::SwitchToWaiting)?;
            if id != Some(NodeId::to_lss(node_id)) {
                faults.push(format!("{board} after its restart: {}", node_id_text(id)));
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
    fn store_heartbeat(&mut self, node: u8, milliseconds: u16) -> Outcome<()> {
        const SAVE: u32 = u32::from_le_bytes(*b"save");
        let written = self.set_heartbeat(node, milliseconds)?;
        let saved =
            sdo::write(&mut self.bus, node, (0x1010, 1), SAVE, 4)?.map_err(|why| why.short());
        Ok(written.and(saved).map_err(|failure| format!("heartbeat time: {failure}")))
    }

    /// Connects to the adapter again if it has vanished, as a USB plug that was pulled and put back does.
    fn reopen(&mut self) -> Result<(), Stop> {
        const LIMIT: Duration = Duration::from_secs(10);
        let until = Instant::now() + LIMIT;
        loop {
            match self.bus.open(self.bus.rate()) {
                Err(Stop::NoAdapter(_) | Stop::AdapterGone(_)) if Instant::now() < until => {
                    thread::sleep(Duration::from_millis(500));
                    self.bus.check_interrupt()?;
                }
                outcome => return outcome,
            }
        }
    }
}
