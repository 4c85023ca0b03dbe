//! What the commissioner does with its network, in the task that runs when no other does.

use canopen_node::{
    BitRate, BitRateSetting, Frame, Instant, NodeId,
    lss::{Address, Request},
    nmt, sdo,
};
use canopen_stm32f4::{now, watchdog::Task};
use example_commissioner::application::{Application, BOARDS, State};
use lss_master::{
    Bus, Configure, Error, Fastscan, InquireNodeId, Master, Member, Procedure, SelectAlone,
    SwitchBitRate, Timing, run,
};
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
/// The switch delay, and its part in which the last requests leave: two frames at 10 kbit/s.
const DELAY_MS: u16 = 200;
const LEAVE_MS: u16 = 30;
/// For slaves that look for frames once in 10 ms.
const TIMING: Timing = Timing { answer: 100_000, store: 1_000_000, margin: 10_000, gap: 0 };

/// Another LSS master was heard, which ends what is under way.
#[derive(Clone, Copy)]
pub struct Rival;

type Outcome<T> = Result<T, Rival>;

/// The network, as its master uses it.
pub struct Network<R> {
    runner: R,
    master: Master,
    button: &'static ErasedPin<Input>,
    serial_number: u32,
    heeds_rivals: bool,
    /// The bit rate that a switch under way leads to.
    next_rate: Option<BitRate>,
}

impl<R: Mutex<T = Runner>> Bus for Network<R> {
    type Error = Rival;

    fn now(&self) -> Instant {
        now()
    }

    fn send(&mut self, frame: &Frame) -> Outcome<()> {
        self.runner.lock(|runner| runner.send(*frame));
        if *frame == Request::ActivateBitTiming(DELAY_MS).to_frame()
            && let Some(rate) = self.next_rate.take()
        {
            // The node itself takes part, when the request has left. Its delays end with those of the others.
            self.pause(u32::from(LEAVE_MS) * 1_000)?;
            self.runner.lock(|runner| runner.switch_bit_rate(rate, DELAY_MS - LEAVE_MS / 2));
        }
        Ok(())
    }

    fn receive(&mut self, until: Instant, mut take: impl FnMut(&Frame, Instant)) -> Outcome<()> {
        self.sleep(until, true)?;
        if let Some((frame, at)) = self.change(Application::take_answer) {
            take(&frame, at);
        }
        Ok(())
    }

    fn set_bit_rate(&mut self, _: BitRate) -> Outcome<()> {
        Ok(())
    }
}

impl<R: Mutex<T = Runner>> Network<R> {
    pub fn new(runner: R, button: &'static ErasedPin<Input>, serial_number: u32) -> Self {
        let master = Master::new(TIMING);
        Self { runner, master, button, serial_number, heeds_rivals: false, next_rate: None }
    }

    /// Commissions the network at power-on, and again when the button or a client asks for it, or a board has lost its
    /// node-ID.
    pub fn commission(mut self) -> ! {
        let mut takes = false;
        loop {
            self.change(|network| network.state = State::Asking as u8);
            self.change(Application::listen);
            self.heeds_rivals = true;
            let outcome = self.round(takes);
            self.change(|network| network.state = outcome.unwrap_or(State::Rival) as u8);
            if outcome.is_err() {
                // Another commissioner waits for another time.
                let more = (now().as_micros() ^ self.serial_number) & 0xF_FFFF;
                while self.pause(QUIET_MICROS + more).is_err() {
                    self.change(Application::listen);
                }
            }
            self.heeds_rivals = false;
            let looks = matches!(outcome, Ok(State::Complete | State::Missing));
            takes = outcome.is_ok() && self.wait_for_orders(looks);
        }
    }

    /// Waits for the button, or for a bit rate from a client; returns whether it is the button. While no other master is
    /// at work, it may look for a board without a node-ID, too.
    fn wait_for_orders(&mut self, looks: bool) -> bool {
        let mut look_at = now().plus_micros(LOOK_MICROS);
        while self.button.is_low() && self.read(Application::asked_rate).is_none() {
            let _ = self.pause(20_000);
            if looks && look_at.has_come(now()) {
                look_at = now().plus_micros(LOOK_MICROS);
                let is_alone = !self.read(Application::has_rival);
                self.change(Application::listen);
                if is_alone && let Ok(Ok(())) = self.run(Request::IdentifyNonConfigured) {
                    break;
                }
            }
        }
        self.button.is_high()
    }

    /// Asks the boards of the table, and gives them their node-IDs. Then switches the bit rate if it is to be another,
    /// or looks for new boards, and takes one if the button was pressed, and more while it is held.
    fn round(&mut self, mut takes: bool) -> Outcome<State> {
        self.pause(LISTEN_MICROS)?;
        self.change(|network| network.present = 0);
        let mut missing = 0;
        for (node, board) in self.read(Application::clone).boards() {
            if !self.give(node, board)? {
                missing |= bit(node);
            }
        }
        if let Some(rate) = self.read(Application::asked_rate) {
            return self.change_bit_rate(rate, missing);
        }
        let mut last = None;
        while let Some(board) = self.scan(last)? {
            let network = self.read(Application::clone);
            let node = match network.boards().find(|(_, known)| *known == board) {
                // It came late. If it does not keep the node-ID, no more is done about it.
                Some((node, _)) if last != Some(board) => node,
                Some(_) => return Ok(State::Conflict),
                None if !takes => return Ok(State::New),
                None => match self.place(&network, board, missing)? {
                    Some(node) if self.keep(&network, node, board) => node,
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

    /// Gives a board its node-ID unless it has it, or another node has it; returns whether the board has it then.
    fn give(&mut self, node: NodeId, board: Address) -> Outcome<bool> {
        let Some(before) = self.ask_node_id(board)? else { return Ok(false) };
        if before != Some(node) {
            if self.is_taken(node)? || self.run(SelectAlone::new(board))?.is_err() {
                return Ok(false);
            }
            let outcome = self.run(Request::ConfigureNodeId(node.get()))?;
            let _ = self.run(Request::SwitchToWaiting)?;
            if let (Ok(()), Some(before)) = (outcome, before) {
                self.send_to(nmt::COMMAND_COB_ID, &[0x82, before.get()]);
            }
            self.pause(ANSWER_MICROS)?;
            if self.ask_node_id(board)? != Some(Some(node)) {
                return Ok(false);
            }
        }
        self.change(|network| network.present |= bit(node));
        Ok(true)
    }

    /// The active node-ID of a board; `None` if it is not there. All are in LSS waiting state afterwards.
    fn ask_node_id(&mut self, board: Address) -> Outcome<Option<Option<NodeId>>> {
        let is_there = self.run(SelectAlone::new(board))?.is_ok();
        let node = if is_there { self.run(InquireNodeId)?.ok() } else { None };
        let _ = self.run(Request::SwitchToWaiting)?;
        Ok(node)
    }

    /// Whether a node has this node-ID: it was heard, or answers by SDO.
    fn is_taken(&mut self, node: NodeId) -> Outcome<bool> {
        let upload_device_type = [0x40, 0x00, 0x10, 0, 0, 0, 0, 0];
        self.send_to(sdo::REQUEST_COB_ID + u16::from(node.get()), &upload_device_type);
        self.pause(ANSWER_MICROS)?;
        let own = self.runner.lock(|runner| runner.node().node_id());
        Ok(own == Some(node) || self.read(|network| network.has_heard(node)))
    }

    /// Looks for a board without a node-ID; it is probably like the last one.
    fn scan(&mut self, last: Option<Address>) -> Outcome<Option<Address>> {
        let scan = Fastscan::new();
        let found = self.run(last.map_or(scan.clone(), |last| scan.after_slave(last)))?;
        let _ = self.run(Request::SwitchToWaiting)?;
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
        self.change(|network| network.set_row(node, board));
        let is_stored = self.store();
        if !is_stored {
            self.change(|network| network.table = before.table);
        }
        is_stored
    }

    /// Stores the table, the bit rate and the order for it. A rival does not end it.
    fn store(&mut self) -> bool {
        self.change(Application::take_stored);
        while !self.runner.lock(Runner::store_values) {
            let _ = self.pause(1_000);
        }
        loop {
            let _ = self.pause(1_000);
            if let Some(is_stored) = self.change(Application::take_stored) {
                return is_stored;
            }
        }
    }

    /// Switches the network to another bit rate, and back if a board does not come. The commissioner stores it first,
    /// with the order, then the boards: after a power cut it goes on with them. A rival does not end it.
    fn change_bit_rate(&mut self, to: BitRate, missing: u32) -> Outcome<State> {
        self.heeds_rivals = false;
        let from = self.bit_rate();
        let network = self.read(Application::clone);
        let mut members = [Member::new([0; 4].into()); BOARDS];
        for (member, (_, board)) in members.iter_mut().zip(network.boards()) {
            member.address = board;
        }
        let members = &mut members[..network.boards().count()];
        let has_come = from == to || missing == 0 && self.switch(members, from, to)?;
        let mut state = State::TakenBack;
        if has_come && self.store() {
            state = State::Complete;
            for (node, board) in network.boards() {
                if !self.store_in(node, board, to)? {
                    state = State::NotStored;
                }
            }
        } else if self.bit_rate() != from {
            members.sort_unstable_by_key(|member| member.outcome.is_err());
            let come = members.partition_point(|member| member.outcome.is_ok());
            self.switch(&mut members[..come], to, from)?;
        }
        self.change(|network| network.bit_rate = 0);
        if has_come {
            self.store();
        }
        Ok(state)
    }

    /// Switches all together; returns whether all have come.
    fn switch(&mut self, members: &mut [Member], from: BitRate, to: BitRate) -> Outcome<bool> {
        self.next_rate = Some(to);
        Ok(self.run(SwitchBitRate::new(members, from, to, DELAY_MS))?.is_ok())
    }

    /// Lets a board store this bit rate, and no node-ID: that is in the table.
    fn store_in(&mut self, node: NodeId, board: Address, rate: BitRate) -> Outcome<bool> {
        if self.run(SelectAlone::new(board))?.is_err() {
            return Ok(false);
        }
        let configure = Configure::node_id(None).with_bit_rate(BitRateSetting::Fixed(rate));
        let outcome = self.run(configure)?;
        let _ = self.run(Request::ConfigureNodeId(node.get()))?;
        let _ = self.run(Request::SwitchToWaiting)?;
        Ok(outcome.is_ok())
    }

    fn run<P: Procedure>(&mut self, procedure: P) -> Outcome<Result<P::Output, Error>> {
        self.change(Application::take_answer);
        let mut master = self.master.clone();
        let outcome = run(self, &mut master, procedure);
        self.master = master;
        outcome
    }

    fn send_to(&mut self, cob_id: u16, data: &[u8]) {
        let frame = Frame::new(cob_id, data);
        frame.into_iter().for_each(|frame| self.runner.lock(|runner| runner.send(frame)));
    }

    fn pause(&mut self, micros: u32) -> Outcome<()> {
        self.sleep(now().plus_micros(micros), false)
    }

    /// Sleeps until this instant, or until an answer is there if `for_answer`; the tick ends each sleep.
    fn sleep(&mut self, until: Instant, for_answer: bool) -> Outcome<()> {
        loop {
            Task::IDLE.answer();
            if self.heeds_rivals && self.read(Application::has_rival) {
                return Err(Rival);
            }
            if until.has_come(now()) || for_answer && self.read(Application::has_answer) {
                return Ok(());
            }
            cortex_m::asm::wfi();
        }
    }

    fn bit_rate(&mut self) -> BitRate {
        self.runner.lock(|runner| runner.node().bit_rate())
    }

    fn read<T>(&mut self, access: impl FnOnce(&Application) -> T) -> T {
        self.runner.lock(|runner| access(runner.node().application()))
    }

    fn change<T>(&mut self, access: impl FnOnce(&mut Application) -> T) -> T {
        self.runner.lock(|runner| runner.application(access))
    }
}

/// The bit of a node-ID, that for 1 first.
const fn bit(node: NodeId) -> u32 {
    1 << (node.get() as u32 - 1)
}
