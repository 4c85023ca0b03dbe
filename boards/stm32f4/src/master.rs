//! The network of an LSS master whose node is on this board, for the task that runs when no other does.

use canopen_node::{BitRate, BitRateSetting, Frame, Instant, NodeId, lss::Request, master::Master};
use lss_master::{Bus, Error, Member, Procedure, SwitchBitRate, Timing, run};
use rtic_core::Mutex;

use crate::{Runner, can::Peripheral, clock::now, task::Task};

/// Another LSS master was heard, which ends what is under way.
#[derive(Clone, Copy)]
pub struct Rival;

/// The network of an LSS master, in the task `idle`, which may wait. An interrupt each millisecond must wake it.
pub struct Network<R> {
    runner: R,
    master: lss_master::Master,
    /// Whether another master ends what is under way.
    pub heeds_rivals: bool,
    /// The bit rate and the switch delay in milliseconds of a switch under way.
    switch: Option<(BitRate, u16)>,
}

impl<R, C, A> Network<R>
where
    R: Mutex<T = Runner<C, A>>,
    C: Peripheral,
    A: Master,
{
    /// The network of the node.
    pub const fn new(runner: R, timing: Timing) -> Self {
        let master = lss_master::Master::new(timing);
        Self { runner, master, heeds_rivals: false, switch: None }
    }

    /// Reads values of the application.
    pub fn read<T>(&mut self, access: impl FnOnce(&A) -> T) -> T {
        self.runner.lock(|runner| access(runner.node().application()))
    }

    /// Reads or changes the application.
    pub fn change<T>(&mut self, access: impl FnOnce(&mut A) -> T) -> T {
        self.runner.lock(|runner| runner.application(access))
    }

    /// The node-ID of the master's own node.
    pub fn node_id(&mut self) -> Option<NodeId> {
        self.runner.lock(|runner| runner.node().node_id())
    }

    /// The bit rate at which the master's own node takes part, or has done so last.
    pub fn bit_rate(&mut self) -> BitRate {
        self.runner.lock(|runner| match runner.node().active_bit_rate() {
            BitRateSetting::Fixed(rate) => rate,
            BitRateSetting::Automatic => runner.node().bit_rate(),
        })
    }

    /// The bit rate that is stored, or was commanded to it since: another one if it has found the others elsewhere.
    pub fn commanded_bit_rate(&mut self) -> BitRate {
        match self.runner.lock(|runner| runner.node().lss().pending_bit_rate()) {
            BitRateSetting::Fixed(rate) => rate,
            BitRateSetting::Automatic => self.bit_rate(),
        }
    }

    /// Sends a frame with this COB-ID.
    pub fn send_to(&mut self, cob_id: u16, data: &[u8]) {
        if let Some(frame) = Frame::new(cob_id, data) {
            self.runner.lock(|runner| runner.send(frame));
        }
    }

    /// Carries out a procedure of the master.
    ///
    /// # Errors
    /// [`Rival`] if it heeds them.
    pub fn run<P: Procedure>(&mut self, procedure: P) -> Result<Result<P::Output, Error>, Rival> {
        self.change(|application| application.inbox().take_answer());
        let mut master = self.master.clone();
        let outcome = run(self, &mut master, procedure);
        self.master = master;
        outcome
    }

    /// Switches the members to another bit rate, with the master's own node, as [`SwitchBitRate`] does.
    ///
    /// # Errors
    /// [`Rival`] if it heeds them.
    pub fn switch_bit_rate(
        &mut self,
        members: &mut [Member],
        from: BitRate,
        to: BitRate,
        delay_ms: u16,
    ) -> Result<Result<(), Error>, Rival> {
        self.switch = Some((to, delay_ms));
        self.run(SwitchBitRate::new(members, from, to, delay_ms))
    }

    /// Stores the values of the application, and the bit rate that was last commanded to the node; returns whether it
    /// has. A rival does not end it.
    pub fn store(&mut self) -> bool {
        self.change(|application| application.inbox().take_stored());
        while !self.runner.lock(|runner| runner.store_values()) {
            let _ = self.pause(1_000);
        }
        loop {
            let _ = self.pause(1_000);
            if let Some(outcome) = self.change(|application| application.inbox().take_stored()) {
                return outcome.is_ok();
            }
        }
    }

    /// Waits for so many microseconds.
    ///
    /// # Errors
    /// [`Rival`] if it heeds them.
    pub fn pause(&mut self, micros: u32) -> Result<(), Rival> {
        self.sleep(now().plus_micros(micros), false)
    }

    /// Sleeps until this instant, or until an answer is there if `for_answer`.
    fn sleep(&mut self, until: Instant, for_answer: bool) -> Result<(), Rival> {
        loop {
            Task::IDLE.answer();
            let heeds_rivals = self.heeds_rivals;
            let (has_rival, has_answer) = self.change(|application| {
                let inbox = application.inbox();
                (inbox.has_rival(), inbox.has_answer())
            });
            if heeds_rivals && has_rival {
                return Err(Rival);
            }
            if until.has_come(now()) || for_answer && has_answer {
                return Ok(());
            }
            cortex_m::asm::wfi();
        }
    }
}

impl<R, C, A> Bus for Network<R>
where
    R: Mutex<T = Runner<C, A>>,
    C: Peripheral,
    A: Master,
{
    type Error = Rival;

    fn now(&self) -> Instant {
        now()
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Rival> {
        self.runner.lock(|runner| runner.send(*frame));
        if let Some((rate, delay_ms)) = self.switch
            && *frame == Request::ActivateBitTiming(delay_ms).to_frame()
        {
            // The node itself takes part, when the request has left.
            let until = now().plus_micros(u32::from(delay_ms) * 250);
            while !self.runner.lock(Runner::is_idle) && !until.has_come(now()) {
                self.pause(1_000)?;
            }
            self.runner.lock(|runner| runner.switch_bit_rate(rate, delay_ms));
        }
        Ok(())
    }

    fn receive(
        &mut self,
        until: Instant,
        mut take: impl FnMut(&Frame, Instant),
    ) -> Result<(), Rival> {
        self.sleep(until, true)?;
        if let Some((frame, at)) = self.change(|application| application.inbox().take_answer()) {
            take(&frame, at);
        }
        Ok(())
    }

    /// Sets the bit rate of the master's own node alone, which takes part in a switch of the network by itself.
    fn set_bit_rate(&mut self, rate: BitRate) -> Result<(), Rival> {
        self.runner.lock(|runner| runner.switch_bit_rate(rate, 0));
        Ok(())
    }
}
