//! What the commissioner does with its network, in the task that runs when no other does.

use core::mem;

use canopen_node::{
    BitRate, NodeId,
    lss::{Address, Request},
    master::Master,
    nmt, sdo,
};
use canopen_stm32f4::{
    master::{Network, Rival},
    now,
};
use example_commissioner::application::{ALL, Application, BOARDS, State, bit};
use lss_master::{Bus, Configure, Fastscan, InquireNodeId, Member, SelectAlone, Timing};
use rtic::Mutex;
use stm32f4xx_hal::gpio::{ErasedPin, Input};

use crate::app::Runner;

/// How long the boards have to come to the bus, and to send a heartbeat, before they are asked.
const LISTEN_MICROS: u32 = 1_500_000;
/// How long a node has to answer by SDO, or to boot up.
const ANSWER_MICROS: u32 = 50_000;
/// How long a rival must be silent.
const QUIET_MICROS: u32 = 2_000_000;
/// The time between two looks for boards that have lost their node-ID with their power.
const LOOK_MICROS: u32 = 10_000_000;
/// The switch delay.
const DELAY_MS: u16 = 200;
/// For slaves that look for frames once in 10 ms.
const TIMING: Timing = Timing { answer: 100_000, store: 1_000_000, margin: 10_000, gap: 0 };

type Outcome<T> = Result<T, Rival>;

/// The commissioner of a network.
pub struct Commissioner<R> {
    network: Network<R>,
    button: &'static ErasedPin<Input>,
    /// The order for a bit rate is in the flash; at power-on it is one that a power cut has interrupted.
    is_order_stored: bool,
}

impl<R: Mutex<T = Runner>> Commissioner<R> {
    pub fn new(runner: R, button: &'static ErasedPin<Input>) -> Self {
        let mut network = Network::new(runner, TIMING);
        let is_order_stored = network.read(Application::asked_rate).is_some();
        Self { network, button, is_order_stored }
    }

    /// Commissions the network at power-on, and again when the button or a client asks for it, or a board has lost its
    /// node-ID.
    pub fn commission(mut self) -> ! {
        let mut takes = false;
        loop {
            self.network.change(|objects| objects.state = State::Asking as u8);
            self.forget();
            self.network.heeds_rivals = true;
            let outcome = self.round(takes);
            self.network.change(|objects| objects.state = outcome.unwrap_or(State::Rival) as u8);
            if outcome.is_err() {
                while self.network.pause(QUIET_MICROS).is_err() {
                    self.forget();
                }
            }
            self.network.heeds_rivals = false;
            let looks = matches!(outcome, Ok(State::Complete | State::Missing));
            takes = outcome.is_ok() && self.wait_for_orders(looks);
        }
    }

    /// Waits for the button, or for a bit rate from a client; returns whether it is the button. While no other master is
    /// at work, it may look for a board without a node-ID, too.
    fn wait_for_orders(&mut self, looks: bool) -> bool {
        let mut look_at = now().plus_micros(LOOK_MICROS);
        while self.button.is_low() && self.network.read(Application::asked_rate).is_none() {
            let _ = self.network.pause(20_000);
            if looks && look_at.has_come(now()) {
                look_at = now().plus_micros(LOOK_MICROS);
                let is_alone = !self.network.change(|objects| objects.inbox().has_rival());
                self.forget();
                if is_alone && let Ok(Ok(())) = self.network.run(Request::IdentifyNonConfigured) {
                    break;
                }
            }
        }
        self.button.is_high()
    }

    /// Asks the boards of the table, and gives them their node-IDs. Then switches the bit rate if it is to be another,
    /// or looks for new boards, and takes one if the button was pressed, and more while it is held.
    fn round(&mut self, mut takes: bool) -> Outcome<State> {
        self.network.pause(LISTEN_MICROS)?;
        self.network.change(|objects| objects.present = 0);
        let mut missing = self.ask(ALL)?;
        if let Some(rate) = self.network.read(Application::asked_rate) {
            return self.change_bit_rate(rate, missing);
        }
        let mut last = None;
        while let Some(board) = self.scan(last)? {
            let objects = self.network.read(Application::clone);
            let node = match objects.boards(ALL).find(|(_, known)| *known == board) {
                // It came late. If it does not keep the node-ID, no more is done about it.
                Some((node, _)) if last != Some(board) => node,
                Some(_) => return Ok(State::Conflict),
                None if !takes => return Ok(State::New),
                None => match self.place(&objects, board, missing)? {
                    Some(node) if self.keep(&objects, node, board) => node,
                    Some(_) => return Ok(State::NotStored),
                    None => return Ok(State::Conflict),
                },
            };
            takes = self.button.is_high();
            last = Some(board);
            if !self.give(node, board)? {
                return Ok(State::Conflict);
            }
            missing &= !bit(node);
        }
        Ok(if missing == 0 { State::Complete } else { State::Missing })
    }

    /// Asks these boards, and gives them their node-IDs; returns those that are missing.
    fn ask(&mut self, boards: u32) -> Outcome<u32> {
        let mut missing = 0;
        for (node, board) in self.network.read(Application::clone).boards(boards) {
            if !self.give(node, board)? {
                missing |= bit(node);
            }
        }
        Ok(missing)
    }

    /// Gives a board its node-ID unless it has it, or another node has it; returns whether the board has it then.
    fn give(&mut self, node: NodeId, board: Address) -> Outcome<bool> {
        let Some(before) = self.ask_node_id(board)? else { return Ok(false) };
        if before != Some(node) {
            if self.is_taken(node)? || self.network.run(SelectAlone::new(board))?.is_err() {
                return Ok(false);
            }
            let outcome = self.network.run(Request::ConfigureNodeId(node.get()))?;
            let _ = self.network.run(Request::SwitchToWaiting)?;
            if let (Ok(()), Some(before)) = (outcome, before) {
                self.network.send_to(nmt::COMMAND_COB_ID, &[0x82, before.get()]);
            }
            self.network.pause(ANSWER_MICROS)?;
            if self.ask_node_id(board)? != Some(Some(node)) {
                return Ok(false);
            }
        }
        self.network.change(|objects| objects.present |= bit(node));
        Ok(true)
    }

    /// The active node-ID of a board; `None` if it is not there. All are in LSS waiting state afterwards.
    fn ask_node_id(&mut self, board: Address) -> Outcome<Option<Option<NodeId>>> {
        let is_there = self.network.run(SelectAlone::new(board))?.is_ok();
        let node = if is_there { self.network.run(InquireNodeId)?.ok() } else { None };
        let _ = self.network.run(Request::SwitchToWaiting)?;
        Ok(node)
    }

    /// Whether a node has this node-ID: it was heard, or answers by SDO.
    fn is_taken(&mut self, node: NodeId) -> Outcome<bool> {
        let upload_device_type = [0x40, 0x00, 0x10, 0, 0, 0, 0, 0];
        let request = sdo::REQUEST_COB_ID + u16::from(node.get());
        self.network.send_to(request, &upload_device_type);
        self.network.pause(ANSWER_MICROS)?;
        let is_heard = self.network.change(|objects| objects.inbox().has_heard(node));
        Ok(is_heard || self.network.node_id() == Some(node))
    }

    /// Looks for a board without a node-ID; it is probably like the last one.
    fn scan(&mut self, last: Option<Address>) -> Outcome<Option<Address>> {
        let scan = Fastscan::new();
        let scan = last.map_or(scan.clone(), |last| scan.after_slave(last));
        let found = self.network.run(scan)?;
        let _ = self.network.run(Request::SwitchToWaiting)?;
        Ok(found.ok().flatten())
    }

    /// The row for a new board: that of the only lost board of the same product, or else the first empty one. No node
    /// has its node-ID.
    fn place(&mut self, from: &Application, new: Address, missing: u32) -> Outcome<Option<NodeId>> {
        let product = |board: Address| (board.vendor_id, board.product_code);
        let is_lost = |node, row: Option<Address>| {
            missing & bit(node) != 0 && row.map(product) == Some(product(new))
        };
        let lost = from.rows().filter(|(node, row)| is_lost(*node, *row)).count();
        for (node, row) in from.rows() {
            let fits = if lost == 0 { row.is_none() } else { lost == 1 && is_lost(node, row) };
            if fits && !self.is_taken(node)? {
                return Ok(Some(node));
            }
        }
        Ok(None)
    }

    /// Writes a board into the table and stores that, before it gets the node-ID. Else the table is as it was.
    fn keep(&mut self, before: &Application, node: NodeId, board: Address) -> bool {
        self.network.change(|objects| objects.set_row(node, board));
        let is_stored = self.network.store();
        if !is_stored {
            self.network.change(|objects| objects.table = before.table);
        }
        is_stored
    }

    /// Switches the network to another bit rate, and back if a board does not come. A rival does not end it.
    ///
    /// The commissioner stores the order, switches, stores the bit rate, and has the boards store it. After a power cut
    /// it goes on: the order tells that boards may be at the other rate.
    fn change_bit_rate(&mut self, to: BitRate, mut missing: u32) -> Outcome<State> {
        self.network.heeds_rivals = false;
        let here = self.network.bit_rate();
        let from = if here == to { self.network.commanded_bit_rate() } else { here };
        let rates: &[BitRate] = match (from == to, self.is_order_stored) {
            // The same rate again is an order to look everywhere for those that are missing.
            (true, false) => &BitRate::ALL,
            (false, true) => &[from, to],
            _ => &[],
        };
        for other in rates.iter().filter(|rate| **rate != here) {
            if missing != 0 {
                self.fetch(missing, *other, here)?;
                missing = self.ask(missing)?;
            }
        }
        let mut come = ALL & !missing;
        let mut has_come = from == to;
        if !has_come && missing == 0 {
            self.is_order_stored = true;
            if self.network.store() {
                come = self.switch(ALL, from, to)?;
                has_come = come == ALL;
            }
        }
        let mut state = State::TakenBack;
        if has_come && self.network.store() {
            self.is_order_stored = true;
            state = self.store_in_boards(to)?;
        } else if self.network.bit_rate() != from {
            self.switch(come, to, from)?;
        }
        self.network.change(|objects| objects.bit_rate = 0);
        if mem::take(&mut self.is_order_stored) {
            self.network.store();
        }
        Ok(state)
    }

    /// Brings those of these boards back that are at the other bit rate.
    fn fetch(&mut self, boards: u32, other: BitRate, here: BitRate) -> Outcome<()> {
        self.network.set_bit_rate(other)?;
        let mut there = 0;
        for (node, board) in self.network.read(Application::clone).boards(boards) {
            if self.ask_node_id(board)?.is_some() {
                there |= bit(node);
            }
        }
        self.switch(there, other, here)?;
        self.network.set_bit_rate(here)
    }

    /// Switches these boards together; returns all but those that have failed.
    fn switch(&mut self, boards: u32, from: BitRate, to: BitRate) -> Outcome<u32> {
        let objects = self.network.read(Application::clone);
        let mut members = [Member::new([0; 4].into()); BOARDS];
        for (member, (_, board)) in members.iter_mut().zip(objects.boards(boards)) {
            member.address = board;
        }
        let members = &mut members[..objects.boards(boards).count()];
        let _ = self.network.switch_bit_rate(members, from, to, DELAY_MS)?;
        let failed = |(board, member): ((NodeId, Address), &Member)| {
            if member.outcome.is_err() { bit(board.0) } else { 0 }
        };
        let failed = objects.boards(boards).zip(&*members).map(failed).sum::<u32>();
        Ok(boards & !failed)
    }

    /// Lets the boards store this bit rate, and no node-ID: that is in the table.
    fn store_in_boards(&mut self, rate: BitRate) -> Outcome<State> {
        let mut state = State::Complete;
        for (node, board) in self.network.read(Application::clone).boards(ALL) {
            let configure = Configure::node_id(None).with_bit_rate(rate.into());
            let mut is_stored = self.network.run(SelectAlone::new(board))?.is_ok();
            if is_stored {
                is_stored = self.network.run(configure)?.is_ok();
                let _ = self.network.run(Request::ConfigureNodeId(node.get()))?;
            }
            let _ = self.network.run(Request::SwitchToWaiting)?;
            if !is_stored {
                state = State::NotStored;
            }
        }
        Ok(state)
    }

    /// Forgets who was heard.
    fn forget(&mut self) {
        self.network.change(|objects| objects.inbox().forget());
    }
}
