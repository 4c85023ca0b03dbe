//! Boards and CAN adapters on one bus or several, and the order in which they advance in time.

mod trace;

use std::sync::MutexGuard;

pub use crate::can::{Noise, Short};
pub use trace::{Event, Recording, Source, What};

use crate::{
    Time,
    board::{Board, Stop},
    can::{Adapter, Bus, Controller, Frame, Station},
    chip::{Chip, ResetCause},
};
use trace::Trace;

/// The longest lead of an awake CPU over the bus and the other boards.
const LOOKAHEAD: Time = Time::from_us(1);
/// The greatest number of CAN controllers of a part.
const CANS: usize = 3;

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct AdapterId(usize);

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct BusId(usize);

/// Boards and adapters on a CAN bus, in virtual time. The same calls always produce the same run.
///
/// A board's controller is on the first bus; [`connect`](Self::connect) puts its other controllers on further buses.
/// A controller without a bus is alone on one of its own. The trace, shorts and noise are of the first bus.
///
/// While every CPU sleeps the bus advances first, up to the next wake-up or interrupt. If one CPU is awake on a quiet
/// bus, it advances first, until it writes to its CAN controller. Otherwise the CPUs run ahead of the bus by at most a
/// microsecond, in the order of the boards. A write to a CAN controller takes effect at its own time; a bus event
/// reaches an awake CPU up to a microsecond late.
pub struct Network {
    now: Time,
    /// The first, those that were added, and those of controllers that are in use and on none of the others.
    buses: Vec<Bus>,
    /// A station may act earlier than the bus expects.
    touched: bool,
    boards: Vec<Board>,
    plugs: Vec<[Option<BusId>; CANS]>,
    /// The time of each board's next event; a board that sleeps longer stays behind in time.
    wake: Vec<Time>,
    adapters: Vec<Adapter>,
    adapter_buses: Vec<BusId>,
    trace: Trace,
    /// The causes of the resets that are allowed, by board; `None`: anything is.
    allowed: Option<Vec<Vec<ResetCause>>>,
}

impl Default for Network {
    fn default() -> Self {
        Self {
            now: Time::ZERO,
            buses: vec![Bus::new()],
            touched: false,
            boards: Vec::new(),
            plugs: Vec::new(),
            wake: Vec::new(),
            adapters: Vec::new(),
            adapter_buses: Vec::new(),
            trace: Trace::default(),
            allowed: None,
        }
    }
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

    pub fn add_bus(&mut self) -> BusId {
        self.buses.push(Bus::at(self.now));
        BusId(self.buses.len() - 1)
    }

    /// Puts another controller of a board, 2 for CAN2, on a bus.
    pub fn connect(&mut self, board: usize, controller: usize, bus: BusId) {
        self.plugs[board][controller - 1] = Some(bus);
    }

    /// Connects a board's controller to the first bus and returns the board's number. If the network has already run,
    /// the board is powered on now.
    pub fn add_board(&mut self, mut board: Board) -> usize {
        if board.now() < self.now() {
            board.power_off();
            board.run_until(self.now());
            board.power_on();
        }
        let mut plugs = [None; CANS];
        plugs[board.controller() - 1] = Some(BusId::default());
        self.plugs.push(plugs);
        self.boards.push(board);
        self.wake.push(self.now);
        self.allowed.iter_mut().for_each(|allowed| allowed.push(Vec::new()));
        self.boards.len() - 1
    }

    /// Connects an adapter to the first bus.
    pub fn add_adapter(&mut self, adapter: Adapter) -> AdapterId {
        self.add_adapter_to(BusId::default(), adapter)
    }

    pub fn add_adapter_to(&mut self, bus: BusId, mut adapter: Adapter) -> AdapterId {
        adapter.plug_in(self.now, self.buses[bus.0].level());
        self.adapters.push(adapter);
        self.adapter_buses.push(bus);
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

    pub fn boards(&self) -> &[Board] {
        &self.boards
    }

    /// An adapter, to change its bit rate or to close it.
    pub fn adapter_mut(&mut self, adapter: AdapterId) -> &mut Adapter {
        let level = self.buses[self.adapter_buses[adapter.0].0].level();
        let adapter = &mut self.adapters[adapter.0];
        adapter.controller().settle(self.now, level);
        adapter
    }

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

    pub fn power_on(&mut self, board: usize) {
        if !self.boards[board].is_powered() {
            self.boards[board].power_on();
            self.trace.push(self.boards[board].now(), Source::Board(board), What::PowerOn);
        }
    }

    /// Short-circuits the bus from now on, or repairs it.
    pub fn set_short(&mut self, short: Option<Short>) {
        self.buses[0].set_short(short, self.now);
    }

    /// Starts or stops noise on the bus.
    pub fn set_noise(&mut self, noise: Option<Noise>) {
        self.buses[0].set_noise(noise, self.now);
    }

    /// Disconnects a station from the bus: it then receives only its own output.
    pub fn cut_wire(&mut self, station: Source) {
        self.with_controller(station, |controller| controller.cut(true));
    }

    pub fn mend_wire(&mut self, station: Source) {
        self.with_controller(station, |controller| controller.cut(false));
    }

    /// Inverts a station's first sample at or after `at`: a bit error that only it sees.
    pub fn flip_bit(&mut self, station: Source, at: Time) {
        self.with_controller(station, |controller| controller.flip(at));
    }

    /// Applies `act` to a station's controller when the bus has reached the current time.
    fn with_controller(&mut self, station: Source, act: impl FnOnce(&mut Controller)) {
        self.buses.iter_mut().for_each(|bus| bus.settle(self.now));
        match station {
            Source::Board(number) => {
                let board = &self.boards[number];
                act(board.chip().can_mut(board.controller()).controller());
            }
            Source::Adapter(AdapterId(number)) => act(self.adapters[number].controller()),
        }
    }

    pub fn run_until(&mut self, until: Time) {
        self.begin();
        while self.now < until {
            self.step(until);
        }
        self.catch_up();
    }

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

    /// From now on a run ends in a panic if a board has misused its chip, is locked up, or was reset, unless that was a
    /// power-on or is [allowed](Self::allow_reset).
    pub fn forbid_misuse(&mut self) {
        self.allowed = Some((0..self.boards.len()).map(|board| self.resets(board)).collect());
    }

    /// Allows anything again.
    pub fn permit_misuse(&mut self) {
        self.allowed = None;
    }

    /// Allows one reset of the board for this cause.
    ///
    /// # Panics
    /// If a reset that was allowed before has not come.
    pub fn allow_reset(&mut self, board: usize, cause: ResetCause) {
        let resets = self.resets(board);
        if let Some(allowed) = self.allowed.as_mut().map(|allowed| &mut allowed[board]) {
            assert_eq!(resets, *allowed, "the resets of board {board} so far");
            allowed.push(cause);
        }
    }

    /// The causes of the board's resets but power-on.
    fn resets(&self, board: usize) -> Vec<ResetCause> {
        let causes = self.boards[board].resets().iter().map(|(_, cause)| *cause);
        causes.filter(|cause| *cause != ResetCause::PowerOn).collect()
    }

    fn check_for_misuse(&self) {
        let Some(allowed) = &self.allowed else { return };
        for (number, (board, allowed)) in self.boards.iter().zip(allowed).enumerate() {
            if let Some(finding) = board.misuse() {
                panic!("board {number}: {finding}");
            }
            assert_eq!(board.lockup(), None, "board {number}");
            let resets = self.resets(number);
            assert!(allowed.starts_with(&resets), "resets of board {number}: {:?}", board.resets());
        }
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
            if self.wake[board] <= self.now || !self.boards[board].sleep(self.now) {
                self.run_board(board, self.now, self.now);
            }
        }
        self.check_for_misuse();
    }

    /// Runs up to `until`, or to an earlier time that needs a new decision.
    fn step(&mut self, until: Time) {
        let quiet_until = if self.touched { self.now } else { self.next_action() };
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
            if self.touched || self.next_action() <= end { self.run_buses(end) } else { end };
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

    fn next_action(&self) -> Time {
        self.buses.iter().map(Bus::next_action).fold(Time::MAX, Time::min)
    }

    /// Runs the buses until `until`, or to an event that concerns a CPU or an adapter's user; returns which.
    fn run_buses(&mut self, until: Time) -> Time {
        let powered = |(_, board): &(usize, &Board)| board.is_powered();
        let numbers: Vec<usize> =
            self.boards.iter().enumerate().filter(powered).map(|(number, _)| number).collect();
        let mut chips: Vec<MutexGuard<'_, Chip>> =
            numbers.iter().map(|&number| self.boards[number].chip()).collect();
        for (&number, chip) in numbers.iter().zip(&chips) {
            for (can, plug) in chip.cans().iter().zip(&mut self.plugs[number]) {
                if plug.is_none() && can.is_in_use() {
                    *plug = Some(BusId(self.buses.len()));
                    self.buses.push(Bus::at(self.now));
                }
            }
        }
        let mut buses: Vec<Connected<'_>> = self.buses.iter_mut().map(Connected::new).collect();
        for (&number, chip) in numbers.iter().zip(&mut chips) {
            for (can, plug) in chip.cans_mut().iter_mut().zip(self.plugs[number]) {
                if let Some(BusId(bus)) = plug {
                    buses[bus].add(Source::Board(number), &mut **can);
                }
            }
        }
        for (number, (adapter, bus)) in
            self.adapters.iter_mut().zip(&self.adapter_buses).enumerate()
        {
            buses[bus.0].add(Source::Adapter(AdapterId(number)), adapter);
        }
        let reached = advance(&mut buses, until, &mut self.trace);
        drop(buses);
        self.touched = false;

        let mut interrupted = Vec::new();
        for (&number, chip) in numbers.iter().zip(&mut chips) {
            for (can, plug) in chip.cans_mut().iter_mut().zip(self.plugs[number]) {
                if plug == Some(BusId::default()) {
                    self.trace.take_notes(number, &mut **can);
                } else {
                    can.take_notes();
                }
            }
            if chip.cans().iter().any(|can| can.irq_changes()) {
                interrupted.push(number);
            }
        }
        drop(chips);
        for number in interrupted {
            self.run_board(number, reached, reached);
            self.boards[number].chip().cans_mut().iter_mut().for_each(|can| can.update_irq());
            self.wake[number] = self.boards[number].wake_time();
        }
        reached
    }
}

struct Connected<'a> {
    bus: &'a mut Bus,
    sources: Vec<Source>,
    stations: Vec<&'a mut dyn Station>,
}

impl<'a> Connected<'a> {
    fn new(bus: &'a mut Bus) -> Self {
        Self { bus, sources: Vec::new(), stations: Vec::new() }
    }

    fn add(&mut self, source: Source, station: &'a mut dyn Station) {
        self.sources.push(source);
        self.stations.push(station);
    }

    fn advance(&mut self, until: Time, mut trace: Option<&mut Trace>) -> Time {
        let sources = &self.sources;
        self.bus.advance(until, &mut self.stations, &mut |station, controller, event| {
            if let Some(trace) = &mut trace {
                trace.observe(sources[station], controller, event);
            }
        })
    }
}

/// Advances all buses to one time: `until`, or the first instant after which a station requests a stop; returns it.
fn advance(buses: &mut [Connected<'_>], until: Time, trace: &mut Trace) -> Time {
    let [first, others @ ..] = buses else { return until };
    if others.is_empty() {
        return first.advance(until, Some(trace));
    }
    // No bus must run past the stop of another: all go from action to action.
    let mut now = first.bus.now();
    loop {
        first.advance(now, Some(trace));
        for other in &mut *others {
            other.advance(now, None);
        }
        let has_stopped =
            first.bus.has_stopped() || others.iter().any(|other| other.bus.has_stopped());
        if has_stopped || now >= until {
            return now;
        }
        let next = others.iter().map(|other| other.bus.next_action());
        now = next.fold(first.bus.next_action(), Time::min).max(now).min(until);
    }
}
