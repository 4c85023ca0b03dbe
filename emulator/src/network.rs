//! Boards and CAN adapters on one bus, and the order in which they live through the same time.

mod trace;

use std::sync::MutexGuard;

pub use trace::{Event, Recording, Source, What};

use crate::{
    Time,
    board::{Board, Stop},
    can::{Adapter, Bus, Frame, Station},
    chip::Chip,
};
use trace::Trace;

/// How far a CPU that is awake runs ahead of the bus and of the other boards.
const LOOKAHEAD: Time = Time::from_us(1);

/// Names an adapter of a [`Network`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct AdapterId(usize);

/// Boards and adapters on a CAN bus, in virtual time; the same calls give the same run.
///
/// While every CPU sleeps the bus goes first, up to the next wake-up or interrupt. Else the CPUs run ahead of the bus,
/// by at most a microsecond, in the order of the boards: what a program writes to its CAN controller takes effect
/// at its own time, what happens on the bus reaches an awake CPU up to a microsecond late.
#[derive(Default)]
pub struct Network {
    bus: Bus,
    boards: Vec<Board>,
    adapters: Vec<Adapter>,
    trace: Trace,
}

impl Network {
    /// An empty bus at the start of time, which records everything.
    pub fn new() -> Self {
        Self::default()
    }

    /// How far the bus has come.
    pub fn now(&self) -> Time {
        self.bus.now()
    }

    /// Joins a board to the bus and returns its number. In a network that has run already it is switched on now.
    pub fn add_board(&mut self, mut board: Board) -> usize {
        if board.now() < self.now() {
            board.power_off();
            board.run_until(self.now());
            board.power_on();
        }
        self.boards.push(board);
        self.boards.len() - 1
    }

    /// Joins an adapter to the bus.
    pub fn add_adapter(&mut self, mut adapter: Adapter) -> AdapterId {
        adapter.plug_in(self.now(), self.bus.level());
        self.adapters.push(adapter);
        AdapterId(self.adapters.len() - 1)
    }

    /// A board, by the number that [`add_board`](Self::add_board) gave.
    pub fn board(&self, board: usize) -> &Board {
        &self.boards[board]
    }

    /// A board, by the number that [`add_board`](Self::add_board) gave.
    pub fn board_mut(&mut self, board: usize) -> &mut Board {
        &mut self.boards[board]
    }

    /// The boards, by number.
    pub fn boards(&self) -> &[Board] {
        &self.boards
    }

    /// An adapter, to change its bit rate or to close it.
    pub fn adapter_mut(&mut self, adapter: AdapterId) -> &mut Adapter {
        &mut self.adapters[adapter.0]
    }

    /// Queues a frame in an adapter.
    pub fn send(&mut self, adapter: AdapterId, frame: Frame) {
        self.adapters[adapter.0].send(frame);
    }

    /// The oldest frame that an adapter received and nobody took, and when it became valid.
    pub fn receive(&mut self, adapter: AdapterId) -> Option<(Time, Frame)> {
        self.adapters[adapter.0].receive()
    }

    /// Takes the supply of a board away: RAM is lost, flash kept.
    pub fn power_off(&mut self, board: usize) {
        if self.boards[board].is_powered() {
            self.boards[board].power_off();
            self.trace.push(self.boards[board].now(), Source::Board(board), What::PowerOff);
        }
    }

    /// Gives the supply of a board back.
    pub fn power_on(&mut self, board: usize) {
        if !self.boards[board].is_powered() {
            self.boards[board].power_on();
            self.trace.push(self.boards[board].now(), Source::Board(board), What::PowerOn);
        }
    }

    /// Lets everybody live until `until`.
    pub fn run_until(&mut self, until: Time) {
        while self.now() < until {
            self.step(until);
        }
    }

    /// Lets everybody live for a span.
    pub fn run_for(&mut self, span: Time) {
        self.run_until(self.now() + span);
    }

    /// Lets everybody live until an adapter has a frame to receive, at most for the span `timeout`, and takes it.
    pub fn run_until_received(&mut self, adapter: AdapterId, timeout: Time) -> Option<(Time, Frame)> {
        let until = self.now() + timeout;
        loop {
            if let Some(received) = self.receive(adapter) {
                return Some(received);
            }
            if self.now() >= until {
                return None;
            }
            self.step(until);
        }
    }

    /// What happened, in order of time.
    pub fn trace(&self) -> &[Event] {
        self.trace.events()
    }

    /// Chooses how much of the trace is kept from now on.
    pub fn record(&mut self, recording: Recording) {
        self.trace.record(recording);
    }

    /// Lets everybody live up to `until` or an earlier instant where it is time to look again.
    fn step(&mut self, until: Time) {
        let now = self.now();
        let wake = self.boards.iter().map(Board::wake_time).min().unwrap_or(Time::MAX);
        if wake > now + LOOKAHEAD {
            let reached = self.run_bus(until.min(wake));
            self.run_boards(reached);
        } else {
            let end = until.min(now + LOOKAHEAD);
            self.run_boards(end);
            self.run_bus(end);
        }
        for (number, board) in self.boards.iter().enumerate() {
            let mut chip = board.chip();
            chip.can1_mut().update_irq();
            self.trace.take_notes(number, &mut chip);
        }
    }

    fn run_boards(&mut self, until: Time) {
        for (number, board) in self.boards.iter_mut().enumerate() {
            while board.now() < until {
                match board.run_until(until) {
                    Stop::Deadline | Stop::CanWritten => {}
                    Stop::Reset(cause) => self.trace.push(board.now(), Source::Board(number), What::Reset(cause)),
                    Stop::PowerCut => self.trace.push(board.now(), Source::Board(number), What::PowerOff),
                }
            }
        }
    }

    fn run_bus(&mut self, until: Time) -> Time {
        let mut sources = Vec::with_capacity(self.boards.len() + self.adapters.len());
        let mut chips: Vec<MutexGuard<'_, Chip>> = Vec::with_capacity(self.boards.len());
        for (number, board) in self.boards.iter().enumerate().filter(|(_, board)| board.is_powered()) {
            sources.push(Source::Board(number));
            chips.push(board.chip());
        }
        let chips = chips.iter_mut().map(|chip| chip.can1_mut() as &mut dyn Station);
        sources.extend((0..self.adapters.len()).map(|number| Source::Adapter(AdapterId(number))));
        let mut stations: Vec<&mut dyn Station> =
            chips.chain(self.adapters.iter_mut().map(|adapter| adapter as &mut dyn Station)).collect();
        let trace = &mut self.trace;
        self.bus.advance(until, &mut stations, |station, controller, event| {
            trace.observe(sources[station], controller, event);
        })
    }
}
