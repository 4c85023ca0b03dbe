//! What every board does around its node: it passes inputs to the node, carries out the actions, keeps the frames that
//! wait for the controller, and watches the bus.
//!
//! A port writes a [`Controller`] and a [`System`]. On a board with interrupts each of them calls a `handle_` function
//! of the [`Runner`]. Any other port calls [`Runner::poll`] in a loop, and may wait between two calls.

mod bus;
mod controller;
mod poll;
mod queue;
mod sampler;

use core::mem;

pub use controller::{BusError, Controller, Mode, Received, Sample};
pub use poll::Wake;

use crate::{
    Action, Application, BitRate, BusEvent, Frame, Instant, Node, Service, Services, Settings,
    application::NoApplication,
    emergency::Fault,
    indicator::{self, BusState, Indicators, Lit},
    lss::{State, StoreError},
    sdo::Abort,
    settings::{Found, Log},
};
use bus::Bus;
use embedded_storage::nor_flash::NorFlash;
use queue::TransmitQueue;

/// Writes to the log, if there is one.
macro_rules! log {
    ($level:ident, $($argument:tt)+) => {
        #[cfg(feature = "defmt")]
        defmt::$level!($($argument)+)
    };
}

/// Passes the stored parameters to a node before all other calls, and reports a loss of its settings. `found` is what
/// the log was found with; returns that, or a failure.
pub fn restore<F: NorFlash, A: Application, const STORED_LEN: usize>(
    node: &mut Node<A>,
    log: &mut Log<F, STORED_LEN>,
    found: Found,
) -> Found {
    let restored = log.restore(|parameter| node.restore(parameter));
    if matches!(found, Found::Damaged | Found::ParametersDamaged | Found::OtherLayout) {
        node.handle_fault(Fault::SettingsLost);
    }
    restored.map_or_else(Found::MediumFailed, |()| found)
}

/// What a board has beside its CAN controller: a clock and a reset.
pub trait System {
    /// The present time.
    fn now(&self) -> Instant;

    /// Resets the device as after a power cut.
    fn reset(&mut self);

    /// Sets the interrupt at which [`Runner::handle_alarm`] is called; replaces an earlier one. For boards with
    /// interrupts.
    fn set_alarm(&mut self, _at: Instant) {}

    /// Has another task call [`Runner::take_store`]. For boards that store in a task of its own.
    fn begin_store(&mut self) {}
}

/// The length of a step of the indicators.
const STEP_MICROS: u32 = indicator::STEP_MS * 1000;
/// The steps between two looks at the controller's state: four looks a second.
const SUPERVISION_STEPS: u8 = 250 / indicator::STEP_MS as u8;
/// The time since the start of a step that tells of a debugger that had halted the core.
const HALT_MICROS: u32 = 500_000;

/// The node with its controller and the rest of its board.
#[derive(Debug)]
pub struct Runner<C: Controller, S: System, A: Application = NoApplication> {
    node: Node<A>,
    bus: Bus<C>,
    system: S,
    queue: TransmitQueue,
    /// The fault confinement state last seen.
    bus_state: BusState,
    indicators: Indicators,
    /// The start of the indicators' next step.
    step_at: Instant,
    /// The indicators' steps since the last look at the controller's state.
    steps: u8,
    /// A store that has not begun.
    store: Option<Settings>,
}

impl<C: Controller, S: System, A: Application> Runner<C, S, A> {
    /// A node after power-on, and its controller, which takes part in the bus from now on, unless the node wants to
    /// listen first.
    pub fn new(node: Node<A>, can: C, mut system: S) -> Self {
        let step_at = system.now();
        let mut bus = Bus::new(can, node.bit_rate());
        if !node.is_listening() {
            bus.restart(&node.receives(), step_at);
        }
        system.set_alarm(step_at);
        Self {
            node,
            bus,
            system,
            queue: TransmitQueue::new(),
            bus_state: BusState::Good,
            indicators: Indicators::default(),
            step_at,
            steps: 0,
            store: None,
        }
    }

    /// The node.
    pub const fn node(&self) -> &Node<A> {
        &self.node
    }

    /// Changes the node, and carries out what has become due: the application's values, an error of the application, a
    /// TPDO to send.
    pub fn with<R>(&mut self, change: impl FnOnce(&mut Node<A>) -> R) -> R {
        let result = change(&mut self.node);
        self.finish();
        result
    }

    /// Reads or changes the application's values.
    pub fn application<R>(&mut self, access: impl FnOnce(&mut A) -> R) -> R {
        self.with(|node| access(node.application_mut()))
    }

    /// Whether every frame of the node has been sent and acknowledged, or dropped.
    pub fn is_idle(&mut self) -> bool {
        self.queue.is_empty() && self.bus.can.is_idle()
    }

    /// Whether the controller was bus-off at the last look.
    pub fn is_bus_off(&self) -> bool {
        self.bus_state == BusState::BusOff
    }

    /// Gives the answer to an SDO download that was put off, as [`Node::answer`] does.
    pub fn answer(&mut self, outcome: Result<(), Abort>) {
        if let Some(answer) = self.node.answer(outcome) {
            self.act(answer);
        }
        self.finish();
    }

    /// The controller and the rest of the board, for a port that waits for them.
    pub const fn parts_mut(&mut self) -> (&mut C, &mut S) {
        (&mut self.bus.can, &mut self.system)
    }

    /// Handles received frames.
    pub fn handle_received(&mut self) {
        let mut now = self.event_time();
        while let Some(received) = self.bus.can.receive() {
            self.bus.has_heard = true;
            self.bus.sampler.note_frame();
            match received {
                Received::Frame(frame) => {
                    // Deadlines before the frame come first; but a frame found by a look counts at the rate where it
                    // was found.
                    if self.node.is_due(now) && !self.bus.is_listening() {
                        self.act_until_nothing_is_due();
                    }
                    if let Some(action) = self.node.handle_frame(&frame, now) {
                        self.act(action);
                    }
                }
                Received::Other => self.node.handle_bus_event(BusEvent::Received, now),
                Received::Overrun => {
                    log!(warn, "CAN: overrun, a received frame was lost");
                    self.node.handle_bus_event(BusEvent::Overrun, now);
                }
            }
            self.act_until_nothing_is_due();
            now = self.system.now();
        }
        self.finish();
    }

    /// Handles frames that were sent or dropped.
    pub fn handle_transmitted(&mut self) {
        let now = self.event_time();
        let sent = self.bus.can.take_sent();
        // The others are less urgent, and wait until it is sent.
        self.queue.pop_if(|(frame, service)| self.bus.can.send(frame, *service));
        self.node.handle_sent(sent, now);
        if self.node.is_due(now) || self.node.wants_to_send_more() {
            self.finish();
        }
    }

    /// Handles an error on the bus, or a change of the controller's error state.
    pub fn handle_status(&mut self) {
        let now = self.event_time();
        let (transmit, receive) = self.bus.can.error_counters();
        let counters = BusEvent::ErrorCounters { transmit, receive };
        self.node.handle_bus_event(counters, now);
        if let Some(error) = self.bus.can.take_error() {
            self.bus.sample(now);
            if let Some(event) = error.event() {
                self.bus.has_heard = true;
                self.node.handle_bus_event(event, now);
            }
        }
        self.watch_bus();
        self.finish();
    }

    /// Reports bus-off and the recovery, unless it is listening.
    fn watch_bus(&mut self) {
        if self.bus.is_listening() {
            return;
        }
        let state = self.bus.can.bus_state();
        let before = mem::replace(&mut self.bus_state, state);
        if state != before {
            log!(
                info,
                "CAN: error counters: transmit {=u8}, receive {=u8}",
                self.bus.can.error_counters().0,
                self.bus.can.error_counters().1
            );
        }
        match (before == BusState::BusOff, state == BusState::BusOff) {
            (false, true) => {
                log!(
                    error,
                    "CAN: bus-off, too many frames failed; check bit rate, wiring and termination"
                );
                self.node.handle_bus_event(BusEvent::BusOff, self.system.now());
            }
            (true, false) => {
                log!(info, "CAN: recovered from bus-off");
                self.node.handle_bus_event(BusEvent::BusOffRecovered, self.system.now());
            }
            _ => {}
        }
    }

    /// Checks the controller, a few times a second: it need not report its recovery from bus-off, may not have started,
    /// and as a listener may receive nothing on a dominant bus.
    fn supervise(&mut self) {
        self.bus.can.supervise();
        let is_deaf = self.bus.is_listening()
            && !self.bus.has_heard
            && self.bus.can.sample().is_some_and(|sample| !sample.is_recessive);
        self.bus.has_heard = false;
        if is_deaf || !self.bus.is_started {
            self.restart();
        }
        self.watch_bus();
    }

    /// Does what is due now; returns the indicators to light, at the start of each of their steps.
    pub fn handle_alarm(&mut self) -> Option<Lit> {
        let now = self.event_time();
        self.act_until_nothing_is_due();
        if self.bus.sampler.is_due(now) {
            self.bus.can.report_errors();
            let sample = self.bus.can.sample();
            let event =
                sample.and_then(|sample| self.bus.sampler.take(sample, self.bus.bit_rate, now));
            if let Some(event) = event {
                self.node.handle_bus_event(event, now);
            }
        }
        let is_step = self.step_at.has_come(now);
        if is_step {
            self.step_at = self.step_at.plus_micros(STEP_MICROS);
            if self.bus.can.sample().is_some_and(|sample| self.bus.sampler.look(sample)) {
                self.bus.sample(self.system.now());
            }
            self.steps = self.steps.wrapping_add(1) % SUPERVISION_STEPS;
            if self.steps == 0 {
                self.supervise();
            }
        }
        self.finish();
        is_step.then(|| self.indicate())
    }

    /// The time of an event. The first one after a halt of the core has it forgotten.
    #[inline(always)] // It is called for each event.
    fn event_time(&mut self) -> Instant {
        let now = self.system.now();
        let since_step = now.as_micros().wrapping_sub(self.step_at.as_micros());
        if since_step.wrapping_add(STEP_MICROS) >= HALT_MICROS {
            self.forget_halt(now);
        }
        now
    }

    /// After a halt of the core by a debugger, drops what was to be sent before it and what was received meanwhile: the
    /// others no longer wait for it.
    #[cold]
    fn forget_halt(&mut self, now: Instant) {
        log!(warn, "the core was halted: what came meanwhile is ignored");
        self.step_at = now;
        self.queue.clear();
        self.restart();
        self.node.note_halt();
    }

    fn indicate(&mut self) -> Lit {
        let is_lss_active = self.node.lss().state() == State::Configuration
            || self.node.node_id().is_none()
            || self.node.is_listening();
        self.indicators.step(self.node.nmt_state(), is_lss_active, self.bus.can.bus_state())
    }

    /// The settings to store now, if any. Puts the parameters to store with them in place of the `persistent` ones, and
    /// returns their length. [`handle_stored`](Self::handle_stored) must follow.
    pub fn take_store(
        &mut self,
        persistent: &[u8],
        parameters: &mut [u8],
    ) -> Option<(Settings, usize)> {
        let settings = self.store.take()?;
        Some((settings, self.node.write_parameters(persistent, parameters)))
    }

    /// Refuses the store that the node has asked for, if there is one: for a device that cannot store.
    pub fn refuse_store(&mut self, error: StoreError) {
        if self.store.take().is_some() {
            self.handle_stored(Err(error));
        }
    }

    /// Passes the outcome of a store to the node: the packed parameters that were stored, or why nothing was.
    pub fn handle_stored(&mut self, outcome: Result<&[u8], StoreError>) {
        self.node.handle_stored(outcome);
        self.finish();
    }

    /// Completes the handling of every event.
    #[inline(never)]
    fn finish(&mut self) {
        // The last frame was sent, or dropped with others.
        if self.node.wants_to_send_more() && self.queue.is_empty() && self.bus.can.is_idle() {
            self.node.handle_bus_event(BusEvent::NonePending, self.system.now());
        }
        self.act_until_nothing_is_due();
        self.system.set_alarm(self.alarm_at());
    }

    /// The time of the next [`handle_alarm`](Self::handle_alarm).
    fn alarm_at(&self) -> Instant {
        let mut next = self.step_at;
        if let Some(of_node) = self.node.poll_at() {
            next = next.earlier(of_node);
        }
        if let Some(of_sampler) = self.bus.sampler.next_at() {
            next = next.earlier(of_sampler);
        }
        next
    }

    #[inline(always)] // It is called for each frame, most of which make nothing due.
    fn act_until_nothing_is_due(&mut self) {
        if self.node.is_due(self.system.now()) {
            self.poll_node();
        }
    }

    fn poll_node(&mut self) {
        while let Some(action) = self.node.poll(self.system.now()) {
            self.act(action);
        }
    }

    #[inline(always)] // Most actions are frames.
    fn act(&mut self, action: Action) {
        match action {
            Action::Transmit(frame, service) => self.transmit(frame, service),
            action => self.carry_out(action),
        }
    }

    #[inline(never)]
    fn carry_out(&mut self, action: Action) {
        match action {
            Action::Transmit(..) => {}
            Action::SetNodeId(_id) => {
                log!(info, "node-ID {=u8} (255: none)", crate::NodeId::to_lss(_id));
                self.drop_frames(Services::BUT_LSS);
                self.set_receives();
            }
            Action::SetReceives => self.set_receives(),
            Action::Drop(services) => self.drop_frames(services),
            Action::SetBitRate(rate) => {
                log!(info, "CAN: at {=u16} kbit/s", rate.kbit_per_s());
                self.start(Mode::TakePart, rate);
            }
            Action::Listen(rate) => {
                log!(debug, "CAN: listening at {=u16} kbit/s", rate.kbit_per_s());
                self.start(Mode::Listen, rate);
            }
            Action::Store(settings) => {
                self.store = Some(settings);
                self.system.begin_store();
            }
            Action::ResetDevice => {
                log!(info, "NMT reset node, resetting");
                self.system.reset();
            }
        }
    }

    /// Sends `frame` as soon as the bus allows it.
    #[inline(always)] // The way of an answer.
    fn transmit(&mut self, frame: Frame, service: Service) {
        if !(self.queue.is_empty() && self.bus.can.send(&frame, service)) {
            self.transmit_beside_others(frame, service);
        }
    }

    /// Sends a frame while others are pending.
    fn transmit_beside_others(&mut self, frame: Frame, service: Service) {
        if self.queue.is_behind(&frame) && self.bus.can.send(&frame, service) {
            return;
        }
        if !self.queue.push(frame, service) {
            log!(
                warn,
                "CAN: the transmit queue is full, frame {=u16:#x} was dropped",
                frame.cob_id()
            );
        }
    }

    /// Drops the pending frames of these services; a frame on the bus now continues.
    fn drop_frames(&mut self, services: Services) {
        self.queue.drop_frames(services);
        self.bus.can.drop_frames(services);
    }

    /// Drops the pending frames and runs the controller in this way.
    fn start(&mut self, mode: Mode, bit_rate: BitRate) {
        self.queue.clear();
        (self.bus.mode, self.bus.bit_rate) = (mode, bit_rate);
        self.restart();
    }

    fn restart(&mut self) {
        self.bus.restart(&self.node.receives(), self.system.now());
    }

    #[inline(never)] // Inlined, it takes up to 104 bytes more.
    fn set_receives(&mut self) {
        let receives = self.node.receives();
        self.bus.is_searching = receives.all;
        self.bus.can.set_receives(&receives);
    }
}
