//! A small network as a model for a checker: every reachable state of boards with the real node, of faults, and of an
//! LSS master.
//!
//! The nodes are [`canopen_node::Node`] itself, with bit-rate supervision unless a scenario says otherwise; nothing of
//! their logic is copied. The state of a node is what `Debug` shows, with instants relative to now. A run is limited to a
//! number of procedures and of faults. `cargo test --profile model --package network-model` tries a share and the
//! mutations, `cargo model` all scenarios, each up to 2,000,000 states, breadth first; it prints which are complete.
//!
//! # What happens in it
//! - The master switches a board to LSS configuration state by its address or by Fastscan, gives it the node-ID of its
//!   address and stores it; switches the bit rate of all, with a delay of 10 ms, and stores it; sends NMT reset
//!   communication. Another master takes over at any point, at either bit rate.
//! - Frames are sent; doubled by a retransmission; repeated for 1.2 s while a board at another bit rate destroys them or
//!   nobody acknowledges them. An answer is delayed, doubled, or missed by the master, which gives up waiting.
//! - Power fails and returns at any point. A store takes any time, may fail, and may be completed in a power cut.
//! - The next deadline of a board arrives. Each board has its own clock, so the boards leave a switch in any order.
//!
//! # Properties
//! Each comes with mutations at the interface of the node ([`mutation`]) that the checker must find.
//!
//! - [`KEPT`]: what a power-on would find is what `17 00` confirmed, or what was requested after that.
//! - [`FOUND`]: from each state, or a sample of them, a master without further faults selects every board, in up to 40 s
//!   at each bit rate.
//! - [`ONE_SELECTED`], after a complete Fastscan or switch state selective.
//! - [`OWN_NODE_ID`], by a table of LSS addresses, or in the order of finding while lone bit errors come a second apart.
//!
//! # Two limits of CiA 305
//! Each is kept as a test that expects the violation. Nobody confirms `04 00`: a board whose receiver loses this one
//! frame stays selected. And a master that takes over within the silence of a switch is not heard: the boards ignore its
//! `04 00` until twice the delay has passed. A careful master waits that long at first, and asks the board that it has
//! selected for its serial number (`5D`): two answers show two boards.
//!
//! # What is not in it
//! Bus-off; automatic detection; SDO, PDOs and heartbeats; more than two bit rates; nodes with equal LSS addresses; the
//! settings log, which `cargo verify power-cut` checks. To compare states, a time more than 150 ms away is rounded up to
//! 0.5 s, more than 3 s to 10 s.

pub mod board;
pub mod check;
mod digest;
pub mod master;
pub mod mutation;
pub mod network;
pub mod recovery;

use std::hash::{DefaultHasher, Hash, Hasher};

use canopen_node::{
    BitRate, BusEvent,
    lss::{State, StoreError},
};
use stateright::{Model, Property};

use board::{Board, RATES};
use master::{Master, Task};
use mutation::Mutation;
use network::Network;

pub const KEPT: &str = "nothing confirmed is lost";
pub const FOUND: &str = "every board is found again";
pub const ONE_SELECTED: &str = "at most one board is selected";
pub const OWN_NODE_ID: &str = "every board has its own node-ID";

/// The network and the faults to check.
#[derive(Clone, Debug)]
pub struct Scenario {
    pub boards: usize,
    /// The greatest number of procedures of masters in a run, and of faults.
    pub procedures: u8,
    pub faults: u8,
    /// The boards have bit-rate supervision.
    pub is_supervised: bool,
    /// The master switches the bit rate.
    pub has_switches: bool,
    /// A master waits for the end of a switch, even if it has just taken over.
    pub is_patient: bool,
    /// The master hands out node-IDs in the order of finding, instead of by a table of LSS addresses, and lone bit
    /// errors come a second apart while it configures a board.
    pub is_in_order: bool,
    /// A board may miss a frame that the others receive. On CAN only a receiver that is too slow does.
    pub has_overruns: bool,
    /// The recovery is tried from one in this number of states; 0: from none.
    pub recover_every: u64,
    pub mutation: Option<Mutation>,
}

impl Scenario {
    pub const fn new(boards: usize, procedures: u8, faults: u8) -> Self {
        Self {
            boards,
            procedures,
            faults,
            is_supervised: true,
            has_switches: true,
            is_patient: true,
            is_in_order: false,
            has_overruns: false,
            recover_every: 1,
            mutation: None,
        }
    }

    /// The scenarios of the full check.
    pub fn all() -> Vec<Self> {
        let sampled = |boards, procedures, faults, recover_every| Self {
            recover_every,
            ..Self::new(boards, procedures, faults)
        };
        let plain = |scenario| Self { is_supervised: false, ..scenario };
        let constant = |scenario| Self { has_switches: false, ..scenario };
        let overruns = |scenario| Self { has_overruns: true, ..scenario };
        let in_order = |scenario| Self { is_in_order: true, ..constant(scenario) };
        vec![
            sampled(1, 3, 3, 50),
            overruns(sampled(1, 2, 2, 10)),
            plain(sampled(1, 3, 3, 20)),
            sampled(2, 3, 0, 20),
            in_order(sampled(2, 4, 0, 50)),
            in_order(sampled(3, 3, 0, 50)),
            sampled(2, 1, 1, 20),
            sampled(2, 1, 2, 100),
            sampled(2, 2, 1, 100),
            sampled(2, 2, 2, 100),
            constant(sampled(2, 3, 3, 50)),
            plain(sampled(2, 2, 1, 50)),
            plain(sampled(2, 2, 2, 100)),
            constant(sampled(3, 3, 1, 20)),
            constant(sampled(3, 2, 2, 50)),
            sampled(3, 1, 0, 10),
            sampled(3, 1, 1, 100),
            sampled(3, 2, 1, 100),
        ]
    }

    fn is_recovery_due(&self, network: &Network) -> bool {
        let mut hasher = DefaultHasher::new();
        network.hash(&mut hasher);
        self.recover_every > 0 && hasher.finish().is_multiple_of(self.recover_every)
    }
}

/// An event of the network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// The idle master begins a procedure.
    Begin(Task),
    /// The master sends its next frame.
    Send,
    /// The same, and a retransmission doubles the frame.
    SendTwice,
    /// The same, and one board misses the frame.
    SendPast(usize),
    /// The master waits no longer for an answer.
    GiveUp,
    /// Another master takes over.
    TakeOver(BitRate),
    /// An answer of a board leaves.
    Answer(usize),
    /// The same, and it is repeated later.
    AnswerTwice(usize),
    /// The same, and the master misses it.
    AnswerUnheard(usize),
    /// The next deadline of a board arrives.
    Deadline(usize),
    /// All boards detect a bit error, and a second passes.
    BitError,
    /// The store in progress ends.
    Stored(usize, Result<(), StoreError>),
    /// The power of a board fails; a store in progress may have been completed.
    Cut {
        board: usize,
        is_store_completed: bool,
    },
    PowerOn(usize),
}

impl Event {
    fn is_fault(self, network: &Network) -> bool {
        match self {
            Self::SendTwice
            | Self::SendPast(_)
            | Self::TakeOver(_)
            | Self::AnswerTwice(_)
            | Self::AnswerUnheard(_)
            | Self::Stored(_, Err(_))
            | Self::Cut { .. } => true,
            // A master with patience waits for all answers.
            Self::GiveUp => !network.boards.iter().all(|board| board.is_at_most_late_by(0)),
            Self::Begin(_) | Self::Send | Self::Answer(_) | Self::Deadline(_) => false,
            Self::BitError => false,
            Self::Stored(_, Ok(())) | Self::PowerOn(_) => false,
        }
    }
}

impl Model for Scenario {
    type State = Network;
    type Action = Event;

    fn init_states(&self) -> Vec<Network> {
        let new = |number| Board::new(number, self.is_supervised, self.mutation);
        let boards = (0..self.boards).map(new).collect();
        let Self { procedures, faults, .. } = *self;
        let mut master = Master::new(RATES[0]);
        master.handed_out = self.is_in_order.then_some(0);
        let mut network = Network { boards, master, procedures, faults };
        network.seal();
        vec![network]
    }

    fn actions(&self, network: &Network, events: &mut Vec<Event>) {
        let master = &network.master;
        let boards = 0..network.boards.len();
        let are_late_by = |n| network.boards.iter().all(|board| board.is_at_most_late_by(n));
        match (master.task, master.awaited) {
            (Task::Idle, _) if network.procedures == 0 => {}
            (Task::Idle, _) => {
                events.extend(boards.map(|board| Event::Begin(Task::Select { board, step: 0 })));
                events.push(Event::Begin(Task::Scan { step: 0, found: 0 }));
                events.push(Event::Begin(Task::Command(0x82)));
                let others = RATES.into_iter().filter(|rate| *rate != master.bit_rate);
                if self.has_switches {
                    events.extend(others.map(|to| Event::Begin(Task::Switch { to, step: 0 })));
                }
            }
            (_, None) if self.is_patient && network.is_switching() => {}
            (_, None) if are_late_by(1) => {
                events.push(Event::Send);
                if are_late_by(0) {
                    events.push(Event::SendTwice);
                }
                if self.has_overruns {
                    events.extend(boards.map(Event::SendPast));
                }
            }
            (_, None) => {}
            (_, Some(_)) => events.push(Event::GiveUp),
        }
        let new = RATES.into_iter().filter(|rate| self.has_switches || *rate == RATES[0]);
        let differs = |rate: &BitRate| Master::new(*rate) != *master;
        events.extend(new.filter(differs).map(Event::TakeOver));
        let mut running = network.boards.iter().filter_map(|board| board.running.as_ref());
        if self.is_in_order
            && running.any(|running| running.node.lss().state() == State::Configuration)
        {
            events.push(Event::BitError);
        }
        for (number, board) in network.boards.iter().enumerate() {
            let Some(running) = &board.running else {
                events.push(Event::PowerOn(number));
                continue;
            };
            events.push(Event::Cut { board: number, is_store_completed: false });
            if running.store.is_some() {
                events.push(Event::Cut { board: number, is_store_completed: true });
                events.push(Event::Stored(number, Ok(())));
                events.push(Event::Stored(number, Err(StoreError::MediumAccess)));
            }
            if !running.answers.is_empty() {
                events.extend([Event::Answer(number), Event::AnswerUnheard(number)]);
                if running.answers.len() == 1 {
                    events.push(Event::AnswerTwice(number));
                }
            }
            if board.micros_to_deadline().is_some() {
                events.push(Event::Deadline(number));
            }
        }
        if network.faults == 0 {
            events.retain(|event| !event.is_fault(network));
        }
    }

    fn next_state(&self, network: &Network, event: Event) -> Option<Network> {
        let mut next = network.clone();
        next.faults -= u8::from(event.is_fault(network));
        let mut network = next;
        match event {
            Event::Begin(task) => {
                network.procedures -= 1;
                network.master.task = task;
            }
            Event::Send => network.go_on(1, None),
            Event::SendTwice => network.go_on(2, None),
            Event::SendPast(board) => network.go_on(1, Some(board)),
            Event::GiveUp => network.master.give_up(),
            Event::TakeOver(rate) => network.master = Master::new(rate),
            Event::Answer(board) => {
                network.answer(board, true)?;
            }
            Event::AnswerTwice(board) => {
                let answer = network.answer(board, true)?;
                network.boards[board].running.as_mut()?.answers.insert(0, answer);
            }
            Event::AnswerUnheard(board) => {
                network.answer(board, false)?;
            }
            Event::Deadline(board) => {
                let micros = network.boards[board].micros_to_deadline()?;
                network.boards[board].pass(micros);
            }
            Event::BitError => {
                network.boards.iter_mut().for_each(|board| board.see(BusEvent::Error));
                network.pass(1_000_000);
            }
            Event::Stored(board, outcome) => network.boards[board].end_store(outcome),
            Event::Cut { board, is_store_completed } => {
                network.boards[board].cut(is_store_completed);
            }
            Event::PowerOn(board) => network.boards[board].power_on(),
        }
        network.seal();
        Some(network)
    }

    fn properties(&self) -> Vec<Property<Self>> {
        vec![
            Property::always(KEPT, |_, network: &Network| {
                network.boards.iter().all(Board::keeps_its_word)
            }),
            Property::always(FOUND, |scenario: &Self, network| {
                !scenario.is_recovery_due(network) || recovery::lost(network.clone()).is_empty()
            }),
            Property::always(ONE_SELECTED, |_, network: &Network| {
                let master = &network.master;
                let is_reached = |running: &&board::Running| {
                    running.is_selected() && running.bit_rate == master.bit_rate
                };
                let running = network.boards.iter().filter_map(|board| board.running.as_ref());
                master.selected().is_none() || running.filter(is_reached).count() <= 1
            }),
            Property::always(OWN_NODE_ID, |_, network: &Network| {
                let mut seen = [false; 128];
                let running = network.boards.iter().filter_map(|board| board.running.as_ref());
                let mut active = running.filter_map(|running| running.node.node_id());
                active.all(|id| !std::mem::replace(&mut seen[usize::from(id.get())], true))
            }),
        ]
    }
}
