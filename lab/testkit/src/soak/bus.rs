//! The bus of the long life: it carries frames, makes errors where bit rates differ, and checks each board.

use std::fmt::Write;

use canopen_node::{BitRate, BusEvent, Frame, NodeId, lss, nmt};

use super::{Counts, HEARTBEAT_MS, SECOND, address};
use crate::{
    frames::{self, Frames, number, request, text},
    node_rig::NodeRig,
};

/// The number of errors in succession after which the error flags of a controller destroy no frames.
const PASSIVE: u8 = 16;
/// A lone controller is error passive after this number of attempts; a silent listener can receive it then.
const ATTEMPTS_TO_PASSIVE: usize = 16;
/// The attempts of the master's controller, and the pause in microseconds after each.
const ATTEMPTS: [(usize, u64); 2] = [(20, 1_000), (24, 50_000)];
/// The longest time between two heartbeats of a board that is not a guest.
const LONGEST_GAP: u64 = HEARTBEAT_MS as u64 * 1000 + 1_000;
/// An emergency may be this much later than the end of its cause.
const AFTER_CAUSE: u64 = 5 * SECOND;

/// A place on the bus, with its board.
pub struct Slot {
    pub rig: NodeRig,
    serial_number: u32,
    pub is_powered: bool,
    /// Errors in succession, up to [`PASSIVE`].
    errors: u8,
    heartbeat_at: u64,
    /// It has reported another rate than its home rate, and has not come home to the master since.
    pub is_guest: bool,
    /// The node-ID that the board must have after a power-on, and one whose store was interrupted.
    pub node_id: u8,
    attempted: Option<u8>,
}

pub struct Bus {
    pub slots: Vec<Slot>,
    pub master_rate: BitRate,
    pub now: u64,
    pub counts: Counts,
    /// The time since which nothing has happened.
    quiet_since: Option<u64>,
    answers: Vec<Frame>,
}

impl Slot {
    fn new(rig: NodeRig, serial_number: u32, now: u64) -> Self {
        Self {
            node_id: NodeId::to_lss(rig.node.node_id()),
            rig,
            serial_number,
            is_powered: true,
            errors: 0,
            heartbeat_at: now,
            is_guest: false,
            attempted: None,
        }
    }

    fn takes_part_at(&self) -> Option<BitRate> {
        (self.is_powered && !self.rig.node.is_listening()).then(|| self.rig.bit_rate())
    }

    fn see(&mut self, event: BusEvent) -> Frames {
        self.errors = PASSIVE.min(self.errors + 1);
        self.rig.see(event)
    }

    fn receive(&mut self, frame: &Frame) -> Frames {
        self.errors = 0;
        let is_wanted = matches!(frame.cob_id(), lss::REQUEST_COB_ID | nmt::COMMAND_COB_ID);
        if is_wanted || self.rig.node.is_listening() {
            self.rig.receive(frame)
        } else {
            self.rig.see(BusEvent::Received)
        }
    }
}

impl Bus {
    pub fn new(boards: Vec<NodeRig>, master_rate: BitRate) -> Self {
        let slots = (0..).zip(boards).map(|(number, rig)| Slot::new(rig, number, 0)).collect();
        let counts = Counts::default();
        Self { slots, master_rate, now: 0, counts, quiet_since: None, answers: Vec::new() }
    }

    /// From now on all boards but guests send heartbeats in time, and no emergency.
    pub fn note_quiet(&mut self) {
        self.quiet_since = Some(self.now);
        self.slots.iter_mut().for_each(|slot| slot.heartbeat_at = self.now);
    }

    pub const fn note_event(&mut self) {
        self.quiet_since = None;
    }

    /// Lets time pass, with a call of each board at its deadline.
    pub fn pass(&mut self, us: u64) {
        let end = self.now + us;
        while self.now < end {
            let powered = self.slots.iter().filter(|slot| slot.is_powered);
            let deadline = powered.filter_map(|slot| slot.rig.us_to_deadline()).min();
            let step = deadline.unwrap_or(u64::MAX).clamp(1, end - self.now);
            self.now += step;
            let mut sent = Vec::new();
            for number in 0..self.slots.len() {
                self.note_company(number);
                let slot = &mut self.slots[number];
                if slot.is_powered {
                    sent.push((number, slot.rig.pass_us(step)));
                }
            }
            // Now the clocks of all boards agree.
            for (number, frames) in sent {
                self.carry(number, frames);
            }
        }
        self.check_heartbeats();
    }

    pub fn cut(&mut self, board: usize) {
        self.slots[board].is_powered = false;
    }

    pub fn power_on(&mut self, board: usize) {
        let slot = &mut self.slots[board];
        if slot.is_powered {
            return;
        }
        slot.is_powered = true;
        slot.is_guest = false;
        slot.errors = 0;
        slot.rig.restart();
        // At the rate that it has now.
        self.note_company(board);
        let slot = &mut self.slots[board];
        let frames = slot.rig.pass_us(0);
        let found = NodeId::to_lss(slot.rig.stored().and_then(|settings| settings.node_id));
        let Slot { node_id, attempted, .. } = *slot;
        assert!(
            found == node_id || Some(found) == attempted,
            "{} s: board {board} has node-ID {found:02X}; {node_id:02X} was confirmed",
            self.now / SECOND
        );
        (slot.node_id, slot.attempted) = (found, None);
        self.carry(board, frames);
    }

    pub fn replace(&mut self, board: usize, rig: NodeRig, serial_number: u32) {
        self.slots[board] = Slot::new(rig, serial_number, self.now);
    }

    /// A board reports a fault that it does not have.
    #[cfg(test)]
    pub fn report_fault(&mut self, board: usize) {
        self.note_company(board);
        self.slots[board].rig.node.handle_fault(canopen_node::emergency::Fault::Overrun);
        self.pass(SECOND);
    }

    /// A stranger sends at a bit rate that nobody uses.
    pub fn disturb(&mut self, span: u64, every: u64) {
        for _ in 0..span.div_ceil(every) {
            for number in 0..self.slots.len() {
                self.note_company(number);
                if self.slots[number].is_powered {
                    let frames = self.slots[number].see(BusEvent::Error);
                    self.carry(number, frames);
                }
            }
            self.pass(every);
        }
    }

    /// Sends a request of the LSS master; returns the answers of the next 2 ms.
    pub fn lss(&mut self, text: &str) -> Vec<String> {
        self.send(&request(text));
        self.answers.iter().map(|answer| frames::text(answer)[5..].to_string()).collect()
    }

    /// Sends a frame of the master, for up to 1.2 s; returns whether anyone acknowledges it.
    fn send(&mut self, frame: &Frame) -> bool {
        self.answers.clear();
        let (mut attempt, mut is_sent) = (0, false);
        'attempts: for (count, pause) in ATTEMPTS {
            for _ in 0..count {
                is_sent = self.attempt(None, frame, attempt);
                if is_sent {
                    break 'attempts;
                }
                attempt += 1;
                self.pass(pause);
            }
        }
        self.pass(2_000);
        is_sent
    }

    pub fn expect(&mut self, answer: &str, request: &str) {
        let answers = self.lss(request);
        let is_answered = answers.len() == 1 && answers[0].starts_with(answer);
        assert!(is_answered, "{} s: {request} has the answers {answers:?}", self.now / SECOND);
    }

    /// Stores what is pending in the selected board, and expects this node-ID in it from now on.
    pub fn expect_stored(&mut self, board: usize, node_id: u8) {
        self.expect("17 00", "17");
        self.note_stored(board, node_id, true);
    }

    /// Records a store of a node-ID, which was confirmed or interrupted.
    pub fn note_stored(&mut self, board: usize, node_id: u8, is_confirmed: bool) {
        let slot = &mut self.slots[board];
        slot.attempted = (!is_confirmed).then_some(node_id);
        if is_confirmed {
            slot.node_id = node_id;
        }
    }

    /// Whether the board answers switch state selective, which ends with the board in configuration state.
    fn is_selected(&mut self, board: usize) -> bool {
        let address = address(self.slots[board].serial_number);
        if !self.send(&request("04 00")) {
            return false;
        }
        let mut answers = Vec::new();
        for (command, part) in (0x40..).zip(<[u32; 4]>::from(address)) {
            answers = self.lss(&format!("{command:02X} {}", number(part)));
        }
        assert!(answers.len() <= 1, "{} s: {answers:?}", self.now / SECOND);
        answers.len() == 1
    }

    pub fn select(&mut self, board: usize) {
        assert!(self.is_selected(board), "{} s: board {board}", self.now / SECOND);
    }

    /// Whether the board answers a selection, with its node-ID.
    pub fn answers(&mut self, board: usize) -> bool {
        self.is_selected(board) && {
            let answers = self.lss("5E");
            let node_id = NodeId::to_lss(self.slots[board].rig.node.node_id());
            self.lss("04 00");
            answers.len() == 1 && answers[0].starts_with(&format!("5E {node_id:02X}"))
        }
    }

    /// NMT reset communication of a board.
    pub fn reset_communication(&mut self, board: usize) {
        if let Some(node_id) = self.slots[board].rig.node.node_id() {
            let command = Frame::new(nmt::COMMAND_COB_ID, &[0x82, node_id.get()]);
            self.send(&command.expect("two bytes"));
        }
    }

    /// The boards as text.
    pub fn situation(&self) -> String {
        let mut lines = String::new();
        for (number, slot) in self.slots.iter().enumerate() {
            let rate = slot.rig.bit_rate();
            let node = &slot.rig.node;
            let (state, is_silent) = (node.lss().state(), node.is_listening());
            let _ = writeln!(lines, "board {number}: {rate:?}, {state:?}, silent {is_silent}");
        }
        lines
    }

    /// Whether a station at another bit rate destroys a frame of this one.
    fn is_destroyed(&self, from: Option<usize>, rate: BitRate) -> bool {
        let differs = |slot: &Slot| slot.takes_part_at().is_some_and(|other| other != rate);
        let mut active = self.others(from).filter(|slot| slot.errors < PASSIVE);
        active.any(differs) || from.is_some() && self.master_rate != rate
    }

    /// Whether a frame of this station would be acknowledged.
    fn has_company(&self, from: Option<usize>, rate: BitRate) -> bool {
        let takes_part = |slot: &Slot| slot.takes_part_at() == Some(rate);
        !self.is_destroyed(from, rate) && (from.is_some() || self.others(from).any(takes_part))
    }

    fn others(&self, than: Option<usize>) -> impl Iterator<Item = &Slot> {
        let slots = self.slots.iter().enumerate();
        slots.filter(move |(number, _)| Some(*number) != than).map(|(_, slot)| slot)
    }

    fn note_company(&mut self, number: usize) {
        let rate = self.slots[number].rig.bit_rate();
        self.slots[number].rig.is_acknowledged = self.has_company(Some(number), rate);
    }

    fn carry(&mut self, from: usize, frames: Frames) {
        self.slots[from].rig.take_actions();
        for frame in frames.0 {
            self.judge(from, &frame);
            self.attempt(Some(from), &frame, 0);
        }
    }

    /// One transmission of a frame; returns whether it is valid.
    fn attempt(&mut self, from: Option<usize>, frame: &Frame, attempt: usize) -> bool {
        let rate = from.map_or(self.master_rate, |number| self.slots[number].rig.bit_rate());
        let is_valid = self.has_company(from, rate);
        let is_heard = is_valid || attempt >= ATTEMPTS_TO_PASSIVE && !self.is_destroyed(from, rate);
        self.counts.frames += u64::from(is_valid);
        if let (Some(number), true) = (from, is_valid) {
            self.slots[number].errors = 0;
            if frame.cob_id() == lss::RESPONSE_COB_ID {
                self.answers.push(*frame);
            }
        }
        for number in 0..self.slots.len() {
            if Some(number) == from || !self.slots[number].is_powered {
                continue;
            }
            self.note_company(number);
            let slot = &mut self.slots[number];
            let frames = match slot.rig.bit_rate() == rate {
                true if is_heard => slot.receive(frame),
                true if slot.rig.node.is_listening() => slot.see(BusEvent::FormError),
                _ => slot.see(BusEvent::Error),
            };
            self.carry(number, frames);
        }
        is_valid
    }

    /// Checks that the board may send this frame now.
    fn judge(&mut self, from: usize, frame: &Frame) {
        let (now, quiet_since) = (self.now, self.quiet_since);
        let slot = &mut self.slots[from];
        let name = || format!("{} s: board {from} sends {}", now / SECOND, text(frame));
        if frame.cob_id() == lss::RESPONSE_COB_ID {
            return;
        }
        let node_id = NodeId::to_lss(slot.rig.node.node_id());
        assert_eq!(frame.cob_id() & 0x7F, u16::from(node_id), "{}: a wrong node-ID", name());
        match frame.cob_id() & 0x780 {
            nmt::ERROR_CONTROL_COB_ID => {
                self.counts.heartbeats += 1;
                let gap = now - slot.heartbeat_at;
                slot.heartbeat_at = now;
                let is_quiet = quiet_since.is_some();
                if slot.is_guest && is_quiet {
                    let longest_ms = &mut self.counts.longest_guest_gap_ms;
                    *longest_ms = gap.div_ceil(1000).max(*longest_ms);
                }
                let is_late = gap > LONGEST_GAP && !slot.is_guest;
                assert!(!is_quiet || !is_late, "{}: after {gap} us", name());
            }
            0x080 => {
                self.counts.emergencies += 1;
                let was_guest = slot.is_guest;
                match frame.data() {
                    [0x10, 0xFF, ..] => slot.is_guest = true,
                    [0, 0, ..] => slot.is_guest &= slot.rig.bit_rate() != self.master_rate,
                    _ => {}
                }
                // A guest may come home and leave again.
                let has_cause =
                    was_guest || quiet_since.is_none_or(|since| now < since + AFTER_CAUSE);
                assert!(has_cause, "{}: without a cause", name());
            }
            _ => panic!("{}: not a frame of this life", name()),
        }
    }

    fn check_heartbeats(&self) {
        if self.quiet_since.is_none() {
            return;
        }
        for (number, slot) in self.slots.iter().enumerate() {
            let gap = self.now - slot.heartbeat_at;
            let is_sent = slot.is_guest || gap <= LONGEST_GAP;
            let is_configured = slot.rig.node.node_id().is_some();
            let now = self.now / SECOND;
            assert!(
                is_sent || !is_configured,
                "{now} s: no heartbeat of board {number} for {gap} us"
            );
        }
    }
}
