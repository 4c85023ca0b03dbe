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
/// The time between two questions for boards that have lost their node-ID with their power.
const LOOK_MICROS: u32 = 10_000_000;
/// The switch delay, and its part in which the last requests leave: two frames at 10 kbit/s.
const DELAY_MS: u16 = 200;
const LEAVE_MS: u16 = 30;
/// For slaves that look for frames once in 10 ms.
const TIMING: Timing = Timing { answer: 100_000, store: 1_000_000, margin: 10_000, gap: 0 };

/// Another LSS master was heard.
#[derive(Clone, Copy)]
pub struct Rival;

/// The bus, as the master uses it.
struct Line<R> {
    runner: R,
    /// Whether a rival ends what is under way.
    heeds_rivals: bool,
    /// The bit rate that a switch under way leads to.
    next_rate: Option<BitRate>,
}

impl<R: Mutex<T = Runner>> Line<R> {
    /// Sleeps until this instant, or until an answer is there if `for_answer`; the tick ends each sleep.
    fn sleep(&mut self, until: Instant, for_answer: bool) -> Result<(), Rival> {
        loop {
            Task::IDLE.answer();
            let heeds_rivals = self.heeds_rivals;
            let (is_stopped, is_over) = self.read(|network| {
                (heeds_rivals && network.has_rival(), for_answer && network.has_answer())
            });
            if is_stopped {
                return Err(Rival);
            }
            if is_over || until.has_come(now()) {
                return Ok(());
            }
            cortex_m::asm::wfi();
        }
    }

    fn read<T>(&mut self, access: impl FnOnce(&Application) -> T) -> T {
        self.runner.lock(|runner| access(runner.node().application()))
    }

    fn change<T>(&mut self, access: impl FnOnce(&mut Application) -> T) -> T {
        self.runner.lock(|runner| runner.application(access))
    }
}

impl<R: Mutex<T = Runner>> Bus for Line<R> {
    type Error = Rival;

    fn now(&self) -> Instant {
        now()
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Rival> {
        self.runner.lock(|runner| runner.send(*frame));
        if *frame == Request::ActivateBitTiming(DELAY_MS).to_frame()
            && let Some(rate) = self.next_rate.take()
        {
            // The node itself takes part, when the request has left. Its delays end with those of the others.
            self.sleep(now().plus_micros(u32::from(LEAVE_MS) * 1_000), false)?;
            self.runner.lock(|runner| runner.switch_bit_rate(rate, DELAY_MS - LEAVE_MS / 2));
        }
        Ok(())
    }

    fn receive(
        &mut self,
        until: Instant,
        mut take: impl FnMut(&Frame, Instant),
    ) -> Result<(), Rival> {
        self.sleep(until, true)?;
        if let Some((frame, at)) = self.change(Application::take_answer) {
            take(&frame, at);
        }
        Ok(())
    }

    fn set_bit_rate(&mut self, _: BitRate) -> Result<(), Rival> {
        Ok(())
    }
}

/// The network with its master.
pub struct Network<R> {
    line: Line<R>,
    master: Master,
    button: &'static ErasedPin<Input>,
    serial_number: u32,
}

impl<R: Mutex<T = Runner>> Network<R> {
    pub fn new(runner: R, button: &'static ErasedPin<Input>, serial_number: u32) -> Self {
        Self {
            line: Line { runner, heeds_rivals: false, next_rate: None },
            master: Master::new(TIMING),
            button,
            serial_number,
        }
    }

    /// Commissions the network at power-on, and again when the button or a client asks for it, or a board has no
    /// node-ID.
    pub fn commission(mut self) -> ! {
        let mut takes = false;
        loop {
            self.set_state(State::Asking);
            self.line.heeds_rivals = true;
            self.line.change(Application::listen);
            let outcome = self.round(takes);
            self.set_state(outcome.unwrap_or(State::Rival));
            if outcome.is_err() {
                // Another commissioner waits for another time.
                let more = (now().as_micros() ^ self.serial_number) & 0xF_FFFF;
                while self.pause(QUIET_MICROS + more).is_err() {
                    self.line.change(Application::listen);
                }
            }
            self.line.heeds_rivals = false;
            takes = outcome.is_ok() && self.wait_for_orders();
        }
    }

    /// Waits for the button, a bit rate from a client, or a board that has lost its node-ID; returns whether it is the
    /// button. It looks for such a board while no other master is at work.
    fn wait_for_orders(&mut self) -> bool {
        let state = self.line.read(|network| network.state);
        let looks = [State::Complete as u8, State::Missing as u8].contains(&state);
        let mut look_at = now().plus_micros(LOOK_MICROS);
        loop {
            let _ = self.pause(20_000);
            if self.button.is_high() {
                return true;
            }
            if self.line.read(|network| network.asked_rate().is_some()) {
                return false;
            }
            if looks && look_at.has_come(now()) {
                look_at = now().plus_micros(LOOK_MICROS);
                let is_alone = !self.line.read(Application::has_rival);
                self.line.change(Application::listen);
                if is_alone && let Ok(Ok(())) = self.run(Request::IdentifyNonConfigured) {
                    return false;
                }
            }
        }
    }

    /// Asks the boards of the table, and gives them their node-IDs. Then switches the bit rate if it is to be another,
    /// or looks for new boards, and takes one if the button was pressed, and more while it is held.
    fn round(&mut self, mut takes: bool) -> Result<State, Rival> {
        self.pause(LISTEN_MICROS)?;
        let mut missing = self.ask_known()?;
        if let Some(rate) = self.line.read(Application::asked_rate) {
            return self.change_bit_rate(rate, missing);
        }
        let mut last = None;
        while let Some(address) = self.scan(last)? {
            let network = self.line.read(Application::clone);
            let row = network.boards().find(|(_, board)| *board == address);
            let node = match row {
                // It came late. If it does not keep the node-ID, no more is done about it.
                Some((node, _)) if last != Some(address) => node,
                Some(_) => return Ok(State::Conflict),
                None if !takes => return Ok(State::New),
                None => {
                    let Some(node) = self.place(&network, address, missing)? else {
                        return Ok(State::Conflict);
                    };
                    // Before it gets the node-ID.
                    self.line.change(|network| network.set_row(node, address));
                    if !self.store() {
                        self.line.change(|now| now.table = network.table);
                        return Ok(State::NotStored);
                    }
                    takes = self.button.is_high();
                    node
                }
            };
            last = Some(address);
            if !self.give(node, address)? {
                return Ok(State::Conflict);
            }
            missing &= !bit(node);
        }
        Ok(if missing == 0 { State::Complete } else { State::Missing })
    }

    /// Gives each board of the table its node-ID; returns the rows without a board, a bit for each.
    fn ask_known(&mut self) -> Result<u32, Rival> {
        let mut missing = 0;
        self.line.change(|network| network.present = 0);
        for (node, address) in self.line.read(Application::clone).boards() {
            if !self.give(node, address)? {
                missing |= bit(node);
            }
        }
        Ok(missing)
    }

    /// Gives a board its node-ID unless it has it, or another node has it; returns whether the board has it then.
    fn give(&mut self, node: NodeId, address: Address) -> Result<bool, Rival> {
        let Some(before) = self.ask_node_id(address)? else { return Ok(false) };
        if before != Some(node) {
            if self.is_taken(node)? || self.run(SelectAlone::new(address))?.is_err() {
                return Ok(false);
            }
            let outcome = self.run(Request::ConfigureNodeId(node.get()))?;
            let _ = self.run(Request::SwitchToWaiting)?;
            if let (Ok(()), Some(before)) = (outcome, before) {
                self.send(nmt::COMMAND_COB_ID, &[0x82, before.get()]);
            }
            self.pause(ANSWER_MICROS)?;
            if self.ask_node_id(address)? != Some(Some(node)) {
                return Ok(false);
            }
        }
        self.line.change(|network| network.present |= bit(node));
        Ok(true)
    }

    /// The active node-ID of a board; `None` if it is not there. All are in LSS waiting state afterwards.
    fn ask_node_id(&mut self, address: Address) -> Result<Option<Option<NodeId>>, Rival> {
        let node = match self.run(SelectAlone::new(address))? {
            Ok(()) => self.run(InquireNodeId)?.ok(),
            Err(_) => None,
        };
        let _ = self.run(Request::SwitchToWaiting)?;
        Ok(node)
    }

    /// Whether a node has this node-ID: it was heard, or answers by SDO.
    fn is_taken(&mut self, node: NodeId) -> Result<bool, Rival> {
        let upload_device_type = [0x40, 0x00, 0x10, 0, 0, 0, 0, 0];
        self.send(sdo::REQUEST_COB_ID + u16::from(node.get()), &upload_device_type);
        self.pause(ANSWER_MICROS)?;
        let own = self.line.runner.lock(|runner| runner.node().node_id());
        Ok(own == Some(node) || self.line.read(|network| network.has_heard(node)))
    }

    /// Looks for a board without a node-ID; it is probably like the last one.
    fn scan(&mut self, last: Option<Address>) -> Result<Option<Address>, Rival> {
        let found =
            self.run(last.map_or(Fastscan::new(), |last| Fastscan::new().after_slave(last)))?;
        let _ = self.run(Request::SwitchToWaiting)?;
        Ok(found.ok().flatten())
    }

    /// The row for a new board: that of the only lost board of the same product, or else the first empty one. No node
    /// has its node-ID.
    fn place(
        &mut self,
        network: &Application,
        new: Address,
        missing: u32,
    ) -> Result<Option<NodeId>, Rival> {
        let product = |board: Address| (board.vendor_id, board.product_code);
        let mut lost = network
            .boards()
            .filter(|(node, board)| missing & bit(*node) != 0 && product(*board) == product(new));
        match (lost.next(), lost.next()) {
            (Some((node, _)), None) => return Ok((!self.is_taken(node)?).then_some(node)),
            (Some(_), Some(_)) => return Ok(None),
            (None, _) => {}
        }
        for (node, _) in network.rows().filter(|(_, row)| row.is_none()) {
            if !self.is_taken(node)? {
                return Ok(Some(node));
            }
        }
        Ok(None)
    }

    /// Stores the table, the bit rate and the order for it.
    fn store(&mut self) -> bool {
        self.line.change(Application::take_stored);
        // A rival does not end it.
        while !self.line.runner.lock(Runner::store_values) {
            let _ = self.pause(1_000);
        }
        loop {
            let _ = self.pause(1_000);
            if let Some(is_stored) = self.line.change(Application::take_stored) {
                return is_stored;
            }
        }
    }

    /// Switches the network to another bit rate, and back if a board does not come. The commissioner stores it first,
    /// with the order, then the boards: after a power cut it goes on with them. A rival does not end it.
    fn change_bit_rate(&mut self, to: BitRate, missing: u32) -> Result<State, Rival> {
        self.line.heeds_rivals = false;
        let from = self.bit_rate();
        let network = self.line.read(Application::clone);
        let present = || network.boards().filter(|(node, _)| missing & bit(*node) == 0);
        let mut members = [Member::new(Address::from([0; 4])); BOARDS as usize];
        for (member, (_, address)) in members.iter_mut().zip(present()) {
            member.address = address;
        }
        let members = &mut members[..present().count()];
        let has_come = from == to || missing == 0 && self.switch(members, from, to)?;
        let mut state = State::TakenBack;
        if has_come {
            state = if self.store() { State::Complete } else { State::NotStored };
        }
        if state == State::Complete {
            for (node, address) in present() {
                if !self.store_in(node, address, to)? {
                    state = State::NotStored;
                }
            }
        } else if self.bit_rate() != from {
            members.sort_unstable_by_key(|member| member.outcome.is_err());
            let come = members.partition_point(|member| member.outcome.is_ok());
            self.switch(&mut members[..come], to, from)?;
        }
        self.line.change(|network| network.bit_rate = 0);
        if has_come {
            self.store();
        }
        Ok(state)
    }

    fn bit_rate(&mut self) -> BitRate {
        self.line.runner.lock(|runner| runner.node().bit_rate())
    }

    /// Switches all together; returns whether all have come.
    fn switch(
        &mut self,
        members: &mut [Member],
        from: BitRate,
        to: BitRate,
    ) -> Result<bool, Rival> {
        self.line.next_rate = Some(to);
        let outcome = self.run(SwitchBitRate::new(members, from, to, DELAY_MS))?;
        self.line.next_rate = None;
        Ok(outcome.is_ok())
    }

    /// Lets a board store its bit rate, and no node-ID: that is in the table.
    fn store_in(&mut self, node: NodeId, board: Address, rate: BitRate) -> Result<bool, Rival> {
        if self.run(SelectAlone::new(board))?.is_err() {
            return Ok(false);
        }
        let configure = Configure::node_id(None).with_bit_rate(BitRateSetting::Fixed(rate));
        let outcome = self.run(configure)?;
        let _ = self.run(Request::ConfigureNodeId(node.get()))?;
        let _ = self.run(Request::SwitchToWaiting)?;
        Ok(outcome.is_ok())
    }

    fn run<P: Procedure>(&mut self, procedure: P) -> Result<Result<P::Output, Error>, Rival> {
        while self.line.change(Application::take_answer).is_some() {}
        run(&mut self.line, &mut self.master, procedure)
    }

    fn send(&mut self, cob_id: u16, data: &[u8]) {
        if let Some(frame) = Frame::new(cob_id, data) {
            self.line.runner.lock(|runner| runner.send(frame));
        }
    }

    fn pause(&mut self, micros: u32) -> Result<(), Rival> {
        self.line.sleep(now().plus_micros(micros), false)
    }

    fn set_state(&mut self, state: State) {
        self.line.change(|network| network.state = state as u8);
    }
}

/// The bit of a node-ID, that for 1 first.
const fn bit(node: NodeId) -> u32 {
    1 << (node.get() as u32 - 1)
}
