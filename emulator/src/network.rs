//! Boards and CAN adapters on one bus, and the order in which they advance in time.

mod trace;

use std::sync::MutexGuard;

pub use crate::can::{Noise, Short};
pub use trace::{Event, Recording, Source, What};

use crate::{
    Time,
    board::{Board, Stop},
    can::{Adapter, Bus, Controller, Frame, Station},
    chip::Chip,
};
use trace::Trace;

/// The longest lead of an awake CPU over the bus and the other boards.
const LOOKAHEAD: Time = Time::from_us(1);

/// The identifier of an adapter of a [`Network`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct AdapterId(usize);

/// Boards and adapters on a CAN bus, in virtual time. The same calls always produce the same run.
///
/// While every CPU sleeps the bus advances first, up to the next wake-up or interrupt. If one CPU is awake on a quiet
/// bus, it advances first, until it writes to its CAN controller. Otherwise the CPUs run ahead of the bus by at most a
/// microsecond, in the order of the boards. A write to a CAN controller takes effect at its own time; a bus event
/// reaches an awake CPU up to a microsecond late.
#[derive(Default)]
pub struct Network {
    now: Time,
    bus: Bus,
    /// A station may act earlier than the bus expects.
    touched: bool,
    boards: Vec<Board>,
    /// The time of each board's next event; a board that sleeps longer stays behind in time.
    wake: Vec<Time>,
    adapters: Vec<Adapter>,
    trace: Trace,
}

impl Network {
    /// An empty bus at the start of time, which records all events.
    pub fn new() -> Self {
        Self::default()
    }

    /// The time that all have reached.
    pub fn now(&self) -> Time {
        self.now
    }

    /// Connects a board to the bus and returns its number. If the network has already run, the board is powered on now.
    pub fn add_board(&mut self, mut board: Board) -> usize {
        if board.now() < self.now() {
            board.power_off();
            board.run_until(self.now());
            board.power_on();
        }
        self.boards.push(board);
        self.wake.push(self.now);
        self.boards.len() - 1
    }

    /// Connects an adapter to the bus.
    pub fn add_adapter(&mut self, mut adapter: Adapter) -> AdapterId {
        adapter.plug_in(self.now, self.bus.level());
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
        let adapter = &mut self.adapters[adapter.0];
        adapter.controller().settle(self.now, self.bus.level());
        adapter
    }

    /// Queues a frame in an adapter.
    pub fn send(&mut self, adapter: AdapterId, frame: Frame) {
        self.adapter_mut(adapter).send(frame);
    }

    /// The oldest unread frame of an adapter, and the time at which it became valid.
    pub fn receive(&mut self, adapter: AdapterId) -> Option<(Time, Frame)> {
        self.adapters[adapter.0].receive()
    }

    /// Cuts the supply of a board: RAM is lost, flash is kept.
    pub fn power_off(&mut self, board: usize) {
        if self.boards[board].is_powered() {
            self.boards[board].power_off();
            self.trace.push(self.boards[board].now(), Source::Board(board), What::PowerOff);
        }
    }

    /// Restores the supply of a board.
    pub fn power_on(&mut self, board: usize) {
        if !self.boards[board].is_powered() {
            self.boards[board].power_on();
            self.trace.push(self.boards[board].now(), Source::Board(board), What::PowerOn);
        }
    }

    /// Short-circuits the bus from now on, or repairs it.
    pub fn set_short(&mut self, short: Option<Short>) {
        self.bus.set_short(short, self.now);
    }

    /// Starts or stops noise on the bus.
    pub fn set_noise(&mut self, noise: Option<Noise>) {
        self.bus.set_noise(noise, self.now);
    }

    /// Disconnects a station from the bus: it then receives only its own output.
    pub fn cut_wire(&mut self, station: Source) {
        self.with_controller(station, |controller| controller.cut(true));
    }

    /// Reconnects a station to the bus.
    pub fn mend_wire(&mut self, station: Source) {
        self.with_controller(station, |controller| controller.cut(false));
    }

    /// Inverts a station's first sample at or after `at`: a bit error that only it sees.
    pub fn flip_bit(&mut self, station: Source, at: Time) {
        self.with_controller(station, |controller| controller.flip(at));
    }

    /// Applies `act` to a station's controller when the bus has reached the current time.
    fn with_controller(&mut self, station: Source, act: impl FnOnce(&mut Controller)) {
        self.bus.settle(self.now);
        match station {
            Source::Board(number) => act(self.boards[number].chip().can1_mut().controller()),
            Source::Adapter(AdapterId(number)) => act(self.adapters[number].controller()),
        }
    }

    /// Runs until `until`.
    pub fn run_until(&mut self, until: Time) {
        self.begin();
        while self.now < until {
            self.step(until);
        }
        self.catch_up();
    }

    /// Runs for a span.
    pub fn run_for(&mut self, span: Time) {
        self.run_until(self.now + span);
    }

    /// Runs until an adapter has received a frame, for at most `timeout`, and returns the frame.
    pub fn run_until_received(
        &mut self,
        adapter: AdapterId,
        timeout: Time,
    ) -> Option<(Time, Frame)> {
        let until = self.now + timeout;
        self.begin();
        let mut received = self.receive(adapter);
        while received.is_none() && self.now < until {
            self.step(until);
            received = self.receive(adapter);
        }
        self.catch_up();
        received
    }

    /// The recorded events, in order of time.
    pub fn trace(&self) -> &[Event] {
        self.trace.events()
    }

    /// Sets the amount of trace to keep from now on.
    pub fn record(&mut self, recording: Recording) {
        self.trace.record(recording);
    }

    /// Checks all boards and adapters again, since anything may have been done to them.
    fn begin(&mut self) {
        self.touched = true;
        for (board, wake) in self.boards.iter().zip(&mut self.wake) {
            *wake = board.wake_time();
        }
    }

    /// Brings the sleeping boards up to the current time.
    fn catch_up(&mut self) {
        for board in 0..self.boards.len() {
            self.run_board(board, self.now, self.now);
        }
    }

    /// Runs up to `until`, or to an earlier time that needs a new decision.
    fn step(&mut self, until: Time) {
        let quiet_until = if self.touched { self.now } else { self.bus.next_action() };
        let soon = until.min(self.now + LOOKAHEAD);
        let (mut first, mut second) = (Time::MAX, Time::MAX);
        for &wake in &self.wake {
            second = second.min(wake.max(first));
            first = first.min(wake);
        }
        let mut end =
            if first > soon { first } else { soon.max(second.min(quiet_until)) }.min(until);
        for board in 0..self.boards.len() {
            if self.wake[board] < end {
                end = self.run_board(board, end, soon);
            }
        }
        self.now =
            if self.touched || self.bus.next_action() <= end { self.run_bus(end) } else { end };
    }

    /// Runs a board until `end`, or to its first write to the CAN controller from `soon` on; returns which.
    fn run_board(&mut self, number: usize, mut end: Time, soon: Time) -> Time {
        let board = &mut self.boards[number];
        while board.now() < end {
            let what = match board.run_until(end) {
                Stop::Deadline => break,
                Stop::CanWritten => {
                    self.touched = true;
                    end = end.min(board.now().max(soon));
                    continue;
                }
                Stop::Reset(cause) => What::Reset(cause),
                Stop::PowerCut => What::PowerOff,
            };
            self.touched = true;
            self.trace.push(board.now(), Source::Board(number), what);
        }
        self.wake[number] = board.wake_time();
        end
    }

    /// Runs the bus until `until`, or to an event that concerns a CPU or an adapter's user; returns which.
    fn run_bus(&mut self, until: Time) -> Time {
        let powered = |(_, board): &(usize, &Board)| board.is_powered();
        let boards: Vec<usize> =
            self.boards.iter().enumerate().filter(powered).map(|(number, _)| number).collect();
        let mut chips: Vec<MutexGuard<'_, Chip>> =
            boards.iter().map(|&number| self.boards[number].chip()).collect();
        let source = |station: usize| match boards.get(station) {
            Some(&number) => Source::Board(number),
            None => Source::Adapter(AdapterId(station - boards.len())),
        };
        let chip_stations = chips.iter_mut().map(|chip| chip.can1_mut() as &mut dyn Station);
        let adapter_stations = self.adapters.iter_mut().map(|adapter| adapter as &mut dyn Station);
        let mut stations: Vec<&mut dyn Station> = chip_stations.chain(adapter_stations).collect();
        let trace = &mut self.trace;
        let reached = self.bus.advance(until, &mut stations, &mut |station, controller, event| {
            trace.observe(source(station), controller, event);
        });
        self.touched = false;

        let mut interrupted = Vec::new();
        for (&number, chip) in boards.iter().zip(&mut chips) {
            self.trace.take_notes(number, chip);
            if chip.can1().irq_changes() {
                interrupted.push(number);
            }
        }
        drop(chips);
        for number in interrupted {
            self.run_board(number, reached, reached);
            self.boards[number].chip().can1_mut().update_irq();
            self.wake[number] = self.boards[number].wake_time();
        }
        reached
    }
}
