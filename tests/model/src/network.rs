//! The network of the model: boards, the bus between them, and a master.

use canopen_node::{BitRate, BusEvent, Frame, lss};

use crate::{board::Board, master::Master};

/// A state of the model.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Network {
    pub boards: Vec<Board>,
    pub master: Master,
    /// The procedures and faults that may still follow.
    pub procedures: u8,
    pub faults: u8,
}

/// The sender of a frame.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Station {
    Master,
    Board(usize),
}

/// A lone controller is error passive after this number of attempts; a silent listener can receive it then.
const ATTEMPTS_TO_PASSIVE: usize = 16;
/// The pauses in microseconds between the attempts of the master's controller: an error frame, later other traffic. It
/// gives up after 1.2 s.
const PAUSES: [(usize, u32); 2] = [(20, 1_000), (24, 50_000)];

impl Network {
    /// Sends a frame of the master, repeated until someone acknowledges it; returns whether that happens.
    pub fn send(&mut self, frame: &Frame, deaf: Option<usize>) -> bool {
        let mut attempt = 0;
        for (count, pause) in PAUSES {
            for _ in 0..count {
                if self.attempt(Station::Master, frame, attempt, deaf) {
                    return true;
                }
                attempt += 1;
                self.pass(pause);
            }
        }
        false
    }

    /// Sends the oldest answer of a board, once; returns whether it is acknowledged.
    pub fn answer(&mut self, board: usize, is_heard_by_master: bool) -> Option<Frame> {
        let answer = *self.boards[board].running.as_ref()?.answers.first()?;
        let rate = self.boards[board].running.as_ref()?.bit_rate;
        if !self.attempt(Station::Board(board), &answer, 0, None) {
            return None;
        }
        let is_heard = is_heard_by_master && rate == self.master.bit_rate;
        if is_heard {
            self.master.receive(&answer);
        }
        Some(answer)
    }

    /// Lets the same time pass for all boards, with a call at each deadline.
    pub fn pass(&mut self, micros: u32) {
        let mut left = micros;
        while left > 0 {
            let deadlines = self.boards.iter().filter_map(Board::micros_to_deadline);
            let step = deadlines.min().unwrap_or(left).clamp(1, left);
            self.boards.iter_mut().for_each(|board| board.pass(step));
            self.exchange();
            left -= step;
        }
    }

    /// Sends the frames of the boards that are not LSS answers, each once.
    pub fn exchange(&mut self) {
        for board in 0..self.boards.len() {
            while let Some(running) = &mut self.boards[board].running
                && !running.messages.is_empty()
            {
                let frame = running.messages.remove(0);
                let rate = running.bit_rate;
                if self.attempt(Station::Board(board), &frame, 0, None)
                    && rate == self.master.bit_rate
                {
                    self.master.hear(&frame);
                }
            }
        }
    }

    /// Whether a board is in the silence of a switch.
    pub fn is_switching(&self) -> bool {
        let mut running = self.boards.iter().filter_map(|board| board.running.as_ref());
        running.any(|running| running.is_switching())
    }

    /// Ends a step of the model.
    pub fn seal(&mut self) {
        self.exchange();
        self.boards.iter_mut().for_each(Board::seal);
    }

    /// One transmission of a frame; returns whether it is acknowledged.
    fn attempt(
        &mut self,
        from: Station,
        frame: &Frame,
        attempt: usize,
        deaf: Option<usize>,
    ) -> bool {
        let Some(rate) = self.bit_rate(from) else { return false };
        let others = || {
            let boards = self.boards.iter().enumerate();
            boards.filter(move |(number, _)| from != Station::Board(*number))
        };
        let running = || others().filter_map(|(_, board)| board.running.as_ref());
        let master = (from != Station::Master).then_some(self.master.bit_rate);
        let is_destroyed = running().any(|other| other.is_active() && other.bit_rate != rate)
            || master.is_some_and(|other| other != rate);
        let is_acknowledged = !is_destroyed
            && (running().any(|other| !other.is_silent && other.bit_rate == rate)
                || master.is_some());
        let receivers: Vec<usize> = others().map(|(number, _)| number).collect();
        for number in receivers {
            let board = &mut self.boards[number];
            let Some(running) = &board.running else { continue };
            let is_valid = is_acknowledged || attempt >= ATTEMPTS_TO_PASSIVE;
            match running.bit_rate == rate && !is_destroyed {
                true if deaf == Some(number) => {}
                true if is_valid => board.receive(frame),
                true => board.see_error(BusEvent::FormError),
                false => board.see_error(BusEvent::Error),
            }
        }
        if let (Station::Board(number), true) = (from, is_acknowledged) {
            let board = &mut self.boards[number];
            if let Some(running) = &mut board.running
                && frame.cob_id() == lss::RESPONSE_COB_ID
            {
                running.answers.remove(0);
            }
            board.see(BusEvent::Acknowledged);
        }
        self.exchange();
        is_acknowledged
    }

    fn bit_rate(&self, station: Station) -> Option<BitRate> {
        match station {
            Station::Master => Some(self.master.bit_rate),
            Station::Board(board) => Some(self.boards[board].running.as_ref()?.bit_rate),
        }
    }

    /// Sends the next frame of the master's procedure, which ends if the frame does not get through.
    pub fn go_on(&mut self, times: usize, deaf: Option<usize>) {
        let Some((frame, awaited)) = self.master.next_frame() else { return };
        if !(0..times).all(|_| self.send(&frame, deaf)) {
            self.master.give_up();
        } else if awaited.is_some() {
            self.master.awaited = awaited;
        } else {
            self.master.advance();
        }
    }
}
