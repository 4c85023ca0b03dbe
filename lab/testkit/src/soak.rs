//! A long life of a network of boards with bit-rate supervision: heartbeats, masters that come and go, power cuts,
//! switches of the bit rate, stores, spare parts. The nodes run in the process, with their settings in flashes.

mod bus;
#[cfg(feature = "image")]
pub mod image;

use canopen_node::{BitRate, lss::Address};

use crate::{
    flash::BoardFlash,
    node_rig::{NodeRig, defaults, device},
    random::Random,
};
use bus::Bus;

/// The number of boards.
pub const BOARDS: usize = 8;
/// The heartbeat time of the boards.
const HEARTBEAT_MS: u16 = 1000;
const SECOND: u64 = 1_000_000;
/// The bit rates of the network.
const RATES: [BitRate; 4] =
    [BitRate::Kbit1000, BitRate::Kbit500, BitRate::Kbit250, BitRate::Kbit125];
/// The time after which every board is found again: the 30 s for which the supervision trusts a switch, the 10 s in
/// which it finds the others, and the time of the selections.
const PATIENCE: u64 = 60 * SECOND;

/// The counts of a life.
#[derive(Clone, Copy, Debug, Default)]
pub struct Counts {
    pub frames: u64,
    pub heartbeats: u64,
    pub emergencies: u64,
    pub power_cuts: u64,
    pub switches: u64,
    pub stores: u64,
    pub interrupted_stores: u64,
    pub replaced: u64,
    pub equal_node_ids: u64,
    pub strangers: u64,
    /// The times that a master made its rate the home rate of guests.
    pub kept_guests: u64,
    pub inquiries: u64,
    /// Selections of a board that was not found yet.
    pub late: u64,
    /// The longest time until all boards were found, in milliseconds.
    pub longest_search_ms: u64,
    /// The longest time between two heartbeats of a guest in the quiet time, in milliseconds.
    pub longest_guest_gap_ms: u64,
}

/// The life of a network.
pub struct Soak {
    bus: Bus,
    random: Random,
    /// The number of boards made.
    made: u32,
    /// The number of the latest kind of event.
    latest: u64,
}

/// The LSS address of the board with this serial number.
const fn address(serial_number: u32) -> Address {
    Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number }
}

fn board(serial_number: u32, node_id: u8, rate: BitRate) -> NodeRig {
    let settings = defaults(node_id).with_bit_rate(rate.into()).with_heartbeat_ms(HEARTBEAT_MS);
    let device = device(address(serial_number)).with_rescue(true);
    let flash = BoardFlash::blank(u64::from(serial_number));
    NodeRig::with_device(
        device.with_defaults(settings),
        flash,
        serial_number.wrapping_mul(0x9E37_79B9),
    )
}

impl Soak {
    /// A network of new boards without node-IDs, which a master then commissions.
    pub fn new(seed: u64) -> Self {
        let rate = BitRate::Kbit125;
        let boards = (0..BOARDS as u32).map(|number| board(number, 0xFF, rate)).collect();
        let mut soak = Self {
            bus: Bus::new(boards, rate),
            random: Random::from_seed(seed),
            made: BOARDS as u32,
            latest: 0,
        };
        for board in 0..BOARDS {
            soak.assign(board, board as u8 + 1);
        }
        soak
    }

    /// Microseconds of virtual time since the start.
    pub const fn now(&self) -> u64 {
        self.bus.now
    }

    pub const fn counts(&self) -> Counts {
        self.bus.counts
    }

    /// Lets a quiet time pass, of up to an hour, and then something happens, after which a master looks for all boards.
    /// Panics if a board breaks a rule.
    pub fn live_on(&mut self) {
        let quiet = self.random.within(60..3600) * SECOND;
        self.bus.pass(quiet);
        self.bus.note_event();
        self.latest = self.random.within(0..10);
        match self.latest {
            0 => self.cut_power(),
            1 => self.cut_power_of_all(),
            2 | 3 => self.switch(),
            4 => self.change_node_id(),
            5 => self.interrupt_store(),
            6 => self.replace(),
            7 => self.add_equal_node_id(),
            8 => self.stranger(),
            _ => {}
        }
        self.find_all();
        if self.bus.slots.iter().any(|slot| slot.is_guest) && !self.random.one_in(3) {
            self.keep_guests();
        }
        self.bus.note_quiet();
    }

    fn any_board(&mut self) -> usize {
        self.random.within(0..BOARDS as u64) as usize
    }

    fn cut_power(&mut self) {
        let board = self.any_board();
        let off = self.random.within(10_000..20 * SECOND);
        self.bus.counts.power_cuts += 1;
        self.bus.cut(board);
        self.bus.pass(off);
        self.bus.power_on(board);
    }

    fn cut_power_of_all(&mut self) {
        for board in 0..BOARDS {
            self.bus.counts.power_cuts += 1;
            self.bus.cut(board);
        }
        self.bus.pass(SECOND);
        for board in 0..BOARDS {
            self.bus.power_on(board);
            let apart = self.random.within(0..300_000);
            self.bus.pass(apart);
        }
    }

    /// A switch of the bit rate, which the power cut of some boards may interrupt at any point.
    fn switch(&mut self) {
        let to = self.random.pick(&RATES);
        let delay_ms = self.random.pick(&[0, 1, 10, 50, 500]);
        let cut_at = self.random.one_in(2).then(|| self.random.within(0..6));
        let is_abandoned = self.random.one_in(4);
        self.bus.counts.switches += 1;
        let select = format!("13 00 {:02X}", to.index());
        let [low, high] = (delay_ms as u16).to_le_bytes();
        let activate = format!("15 {low:02X} {high:02X}");
        let mut cut = Vec::new();
        for (step, request) in ["04 01", &select, &activate, "", "17", "04 00"].iter().enumerate() {
            if cut_at == Some(step as u64) {
                for _ in 0..self.random.within(1..4) {
                    let board = self.any_board();
                    if self.bus.slots[board].is_powered {
                        self.bus.counts.power_cuts += 1;
                        self.bus.cut(board);
                        cut.push(board);
                    }
                }
            }
            if step == 3 {
                let share =
                    if is_abandoned { self.random.within(0..2 * delay_ms * 1000 + 1) } else { 0 };
                self.bus.pass(delay_ms * 1000);
                self.bus.master_rate = to;
                self.bus.pass(delay_ms * 1000 + share + 2_000);
                continue;
            }
            // An abandoned switch is not stored.
            if !(is_abandoned && *request == "17") {
                self.bus.lss(request);
                self.bus.pass(2_000);
            }
        }
        for board in cut {
            let apart = self.random.within(0..2 * SECOND);
            self.bus.pass(apart);
            self.bus.power_on(board);
        }
    }

    fn change_node_id(&mut self) {
        let board = self.any_board();
        let free: Vec<u8> =
            (1..=100).filter(|id| self.bus.slots.iter().all(|slot| slot.node_id != *id)).collect();
        let node_id = self.random.pick(&free);
        self.find_all();
        self.assign(board, node_id);
    }

    /// A store of a node-ID, in which the power fails.
    fn interrupt_store(&mut self) {
        let board = self.any_board();
        let steps = self.random.within(0..9) as usize;
        self.find_all();
        let (old, new) = (self.bus.slots[board].node_id, 127 - board as u8);
        self.bus.select(board);
        self.bus.expect("11 00", &format!("11 {new:02X}"));
        self.bus.slots[board].rig.flash.cut_power_after(steps);
        self.bus.counts.interrupted_stores += 1;
        self.bus.counts.power_cuts += 1;
        let is_confirmed = self.bus.lss("17").iter().any(|answer| answer.starts_with("17 00"));
        self.bus.note_stored(board, new, is_confirmed);
        self.bus.cut(board);
        self.bus.pass(SECOND);
        self.bus.slots[board].rig.flash.power_on();
        self.bus.power_on(board);
        self.bus.pass(3 * SECOND);
        self.find_all();
        self.assign(board, old);
    }

    /// A new board, without a node-ID and with the rate of the factory, in place of an old one.
    fn replace(&mut self) {
        let number = self.any_board();
        let node_id = self.bus.slots[number].node_id;
        let rate = self.random.pick(&RATES);
        self.bus.counts.replaced += 1;
        self.bus.replace(number, board(self.made, 0xFF, rate), self.made);
        self.made += 1;
        self.find_all();
        self.assign(number, node_id);
        self.store_rate(number);
    }

    /// A spare part with the node-ID of another board: the master gives it a free one.
    fn add_equal_node_id(&mut self) {
        let number = self.any_board();
        let other = (number + 1) % BOARDS;
        let node_id = self.bus.slots[number].node_id;
        let equal = self.bus.slots[other].node_id;
        self.bus.counts.equal_node_ids += 1;
        let rate = self.bus.master_rate;
        self.bus.replace(number, board(self.made, equal, rate), self.made);
        self.made += 1;
        self.bus.pass(20 * SECOND);
        self.find_all();
        self.assign(number, node_id);
    }

    /// A stranger sends at a wrong bit rate for some seconds.
    fn stranger(&mut self) {
        let span = self.random.within(SECOND / 10..20 * SECOND);
        let every = self.random.pick(&[5_000, 50_000, 400_000]);
        self.bus.counts.strangers += 1;
        self.bus.disturb(span, every);
    }

    /// Selects a board, gives it a node-ID and stores it.
    fn assign(&mut self, board: usize, node_id: u8) {
        self.bus.counts.stores += 1;
        self.bus.select(board);
        self.bus.expect("11 00", &format!("11 {node_id:02X}"));
        self.bus.expect_stored(board, node_id);
        self.bus.lss("04 00");
        self.bus.reset_communication(board);
        self.bus.pass(2 * SECOND);
    }

    /// Stores the bit rate that a new board has found.
    fn store_rate(&mut self, board: usize) {
        let node_id = self.bus.slots[board].node_id;
        let rate = self.bus.master_rate;
        self.bus.select(board);
        self.bus.expect("13 00", &format!("13 00 {:02X}", rate.index()));
        self.bus.expect_stored(board, node_id);
        self.bus.lss("15 00 00");
        self.bus.pass(10_000);
        self.bus.lss("04 00");
    }

    /// Makes the rate of the master the home rate of all boards.
    fn keep_guests(&mut self) {
        self.bus.counts.kept_guests += 1;
        self.bus.lss("04 01");
        self.bus.lss("15 00 00");
        self.bus.pass(10_000);
        self.bus.lss("04 00");
        // From now on the rules hold for them as for boards at home.
        self.bus.slots.iter_mut().for_each(|slot| slot.is_guest = false);
    }

    /// Selects each board, until all have answered; then they are at the bit rate of the master.
    fn find_all(&mut self) {
        let begin = self.bus.now;
        self.bus.counts.inquiries += 1;
        loop {
            let found = (0..BOARDS).filter(|board| self.bus.answers(*board)).count();
            if found == BOARDS {
                break;
            }
            self.bus.counts.late += (BOARDS - found) as u64;
            assert!(
                self.bus.now < begin + PATIENCE,
                "{} s, event {}: {found} of {BOARDS} boards are found at {:?}\n{}",
                self.bus.now / SECOND,
                self.latest,
                self.bus.master_rate,
                self.bus.situation()
            );
            self.bus.pass(SECOND / 10);
        }
        let took = (self.bus.now - begin) / 1000;
        self.bus.counts.longest_search_ms = self.bus.counts.longest_search_ms.max(took);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sessions::outcome;

    #[test]
    fn each_broken_rule_is_noticed() {
        type Break = fn(&mut Soak);
        let cases: [(&str, Break); 4] = [
            ("7 of 8 boards are found", |soak| {
                soak.bus.note_event();
                soak.bus.cut(3);
                soak.find_all();
            }),
            ("no heartbeat of board 3", |soak| {
                soak.bus.cut(3);
                soak.bus.pass(2 * SECOND);
            }),
            ("63 was confirmed", |soak| {
                soak.bus.note_stored(3, 0x63, true);
                soak.bus.cut(3);
                soak.bus.power_on(3);
            }),
            ("without a cause", |soak| {
                soak.bus.pass(10 * SECOND);
                soak.bus.report_fault(3);
            }),
        ];
        for (notice, break_rule) in cases {
            let mut soak = Soak::new(1);
            soak.find_all();
            soak.bus.note_quiet();
            let error = outcome(|| break_rule(&mut soak)).expect_err(notice).to_string();
            assert!(error.contains(notice), "{error}, not {notice}");
        }
    }
}
