//! The node on its board: passes inputs to the node and carries out its actions, stores among them.

use core::mem;

use canopen_node::{
    Action, Application, BusEvent, Instant, Node, NodeId, Settings,
    indicator::{self, BusState, Indicators, Lit},
    lss::{self, State, StoreError},
    settings::Log,
};
use cortex_m::peripheral::{NVIC, SCB};
use rtic_core::Mutex;

use crate::{
    can::{Controller, Peripheral, Received},
    clock::{self, Alarm},
    flash::{self, SettingsFlash},
    watchdog::{self, Task},
};

/// The node, its controller, and their next deadline.
pub struct Runner<
    C: Peripheral,
    A: Application,
    const TPDOS: usize,
    const RPDOS: usize,
    const PRODUCERS: usize,
> {
    node: Node<A, TPDOS, RPDOS, PRODUCERS>,
    can: Controller<C, RPDOS, PRODUCERS>,
    alarm: Alarm,
    /// The fault confinement state last seen.
    bus_state: BusState,
    indicators: Indicators,
    /// The start of the indicators' next step.
    step_at: Instant,
    /// A store that has not begun; [`Runner::handle_stored`] takes its outcome.
    store: Option<Settings>,
}

impl<C: Peripheral, A: Application, const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize>
    Runner<C, A, TPDOS, RPDOS, PRODUCERS>
{
    /// A node after power-on, and its controller, which takes part in the bus from now on, unless the node wants to
    /// listen first.
    pub fn new(
        node: Node<A, TPDOS, RPDOS, PRODUCERS>,
        mut can: Controller<C, RPDOS, PRODUCERS>,
        mut alarm: Alarm,
    ) -> Self {
        const {
            assert!(
                Node::<A, TPDOS, RPDOS, PRODUCERS>::STORED_LEN <= flash::CAPACITY,
                "the flash has no room for the stored parameters of the application"
            );
        }
        if !node.is_listening() {
            can.set_bit_rate(node.bit_rate(), node.receives());
        }
        let step_at = clock::now();
        alarm.set(step_at);
        Self {
            node,
            can,
            alarm,
            bus_state: BusState::Good,
            indicators: Indicators::default(),
            step_at,
            store: None,
        }
    }

    /// Handles received frames.
    pub fn handle_received(&mut self) {
        while let Some(received) = self.can.receive() {
            match received {
                Received::Frame(frame) => {
                    let now = clock::now();
                    // Deadlines before the frame come first; but a frame found by a look counts at the rate where it
                    // was found.
                    if self.node.is_due(now) && !self.can.is_listening() {
                        self.act_until_nothing_is_due();
                    }
                    if let Some(action) = self.node.handle_frame(&frame, now) {
                        self.act(action);
                    }
                }
                Received::Other => self.node.handle_bus(BusEvent::Received, clock::now()),
                Received::Overrun => {
                    defmt::warn!("CAN: overrun, a received frame was lost");
                    self.node.handle_bus(BusEvent::Overrun, clock::now());
                }
            }
            self.act_until_nothing_is_due();
        }
        self.finish();
        Task::RECEIVED.answer();
    }

    /// Handles frames that were sent or aborted.
    pub fn handle_transmitted(&mut self) {
        if self.can.handle_transmitted() {
            self.node.handle_bus(BusEvent::Acknowledged, clock::now());
            if self.node.wants_to_send_more() && self.can.has_sent_all() {
                self.node.handle_bus(BusEvent::NonePending, clock::now());
            }
            self.finish();
        }
        Task::TRANSMITTED.answer();
    }

    /// Handles a change of the controller's error state, or an error on the bus.
    pub fn handle_status(&mut self) {
        self.check_status();
        Task::STATUS.answer();
    }

    fn check_status(&mut self) {
        let (transmit, receive) = self.can.error_counters();
        let counters = BusEvent::ErrorCounters { transmit, receive };
        self.node.handle_bus(counters, clock::now());
        let error = self.can.handle_status();
        let now = clock::now();
        if let Some(error) = error {
            self.node.handle_bus(error, now);
        }
        if !self.can.is_listening() {
            self.watch_bus();
        }
        self.finish();
    }

    /// Checks the controller, a few times a second: no interrupt reports its recovery from bus-off.
    pub fn supervise(&mut self) {
        self.can.supervise();
        self.check_status();
    }

    fn watch_bus(&mut self) {
        let state = self.can.bus_state();
        let before = mem::replace(&mut self.bus_state, state);
        if state != before {
            let (transmit, receive) = self.can.error_counters();
            defmt::info!("CAN: error counters: transmit {=u8}, receive {=u8}", transmit, receive);
        }
        match (before == BusState::BusOff, state == BusState::BusOff) {
            (false, true) => {
                defmt::error!(
                    "CAN: bus-off, too many frames failed; check bit rate, wiring and termination"
                );
                self.node.handle_bus(BusEvent::BusOff, clock::now());
            }
            (true, false) => {
                defmt::info!("CAN: recovered from bus-off");
                self.node.handle_bus(BusEvent::BusOffRecovered, clock::now());
            }
            _ => {}
        }
    }

    /// Reads or changes the application's values.
    pub fn application<R>(&mut self, access: impl FnOnce(&mut A) -> R) -> R {
        let result = access(self.node.application_mut());
        self.finish();
        result
    }

    /// Reports an error of the application, as [`Node::report`] does.
    pub fn report(&mut self, code: u16, register: u8, information: [u8; 5]) {
        self.node.report(code, register, information);
        self.finish();
    }

    /// Ends an error of the application, as [`Node::end_report`] does.
    pub fn end_report(&mut self, code: u16) {
        self.node.end_report(code);
        self.finish();
    }

    /// Sends a TPDO though no value has changed, as [`Node::send_tpdo`] does.
    pub fn send_tpdo(&mut self, number: u8) {
        self.node.send_tpdo(number);
        self.finish();
    }

    /// Passes the outcome of a store to the node.
    pub fn handle_stored(&mut self, outcome: Result<(), StoreError>) {
        self.node.handle_stored(outcome);
        self.finish();
    }

    /// The settings to store now, if any. Puts the parameters to store with them in place of the `persistent` ones, and
    /// returns their length.
    pub fn take_store(
        &mut self,
        persistent: &[u8],
        parameters: &mut [u8],
    ) -> Option<(Settings, usize)> {
        let settings = self.store.take()?;
        Some((settings, self.node.write_parameters(persistent, parameters)))
    }

    /// Does what is due now; returns the indicators to light, at the start of each of their steps.
    pub fn handle_alarm(&mut self) -> Option<Lit> {
        self.alarm.acknowledge();
        self.act_until_nothing_is_due();
        let now = clock::now();
        if let Some(event) = self.can.watch(now) {
            self.node.handle_bus(event, now);
        }
        let is_step = self.step_at.has_come(now);
        if is_step {
            self.step_at = self.step_at.plus_micros(indicator::STEP_MS * 1000);
            self.can.look();
        }
        self.finish();
        is_step.then(|| self.indicate())
    }

    fn indicate(&mut self) -> Lit {
        let is_lss_active = self.node.lss().state() == State::Configuration
            || self.node.node_id().is_none()
            || self.node.is_listening();
        self.indicators.step(self.node.nmt_state(), is_lss_active, self.can.bus_state())
    }

    /// Completes the handling of every event.
    #[inline(never)]
    fn finish(&mut self) {
        self.act_until_nothing_is_due();
        self.set_alarm();
    }

    #[inline(always)] // It is called for each frame, most of which make nothing due.
    fn act_until_nothing_is_due(&mut self) {
        if self.node.is_due(clock::now()) {
            self.poll_node();
        }
    }

    fn poll_node(&mut self) {
        while let Some(action) = self.node.poll(clock::now()) {
            self.act(action);
        }
    }

    fn set_alarm(&mut self) {
        let mut next = self.step_at;
        if let Some(of_node) = self.node.poll_at() {
            next = next.earlier(of_node);
        }
        if let Some(of_watch) = self.can.watch_at() {
            next = next.earlier(of_watch);
        }
        self.alarm.set(next);
    }

    #[inline(always)] // Most actions are frames.
    fn act(&mut self, action: Action) {
        match action {
            Action::Transmit(frame) => self.can.transmit(frame),
            action => self.carry_out(action),
        }
    }

    fn carry_out(&mut self, action: Action) {
        match action {
            Action::Transmit(_) => {}
            Action::SetNodeId(id) => {
                defmt::info!("node-ID {=u8} (255: none)", NodeId::to_lss(id));
                self.can.drop_frames(|cob_id| cob_id != lss::RESPONSE_COB_ID);
                self.can.set_receives(self.node.receives());
            }
            Action::SetReceives => self.can.set_receives(self.node.receives()),
            Action::DropPdos => {
                self.can.drop_frames(|cob_id| self.node.is_pdo(cob_id));
            }
            Action::StopTransmitting => {
                self.can.stop_transmitting();
            }
            Action::SetBitRate(rate) => {
                defmt::info!("CAN: at {=u16} kbit/s", rate.kbit_per_s());
                self.can.set_bit_rate(rate, self.node.receives());
            }
            Action::ResumeTransmitting => {
                self.can.resume_transmitting();
            }
            Action::Listen(rate) => {
                defmt::debug!("CAN: listening at {=u16} kbit/s", rate.kbit_per_s());
                self.can.listen(rate, self.node.receives());
            }
            Action::Store(settings) => {
                self.store = Some(settings);
                NVIC::pend(watchdog::STORE);
            }
            Action::ResetDevice => {
                defmt::info!("NMT reset node, resetting");
                SCB::sys_reset();
            }
        }
    }
}

/// The log in the flash. `STORED_LEN` is [`Node::STORED_LEN`](canopen_node::Node::STORED_LEN).
pub struct Storage<const STORED_LEN: usize> {
    pub(crate) log: Log<SettingsFlash, STORED_LEN>,
}

impl<const STORED_LEN: usize> Storage<STORED_LEN> {
    /// Stores what the node has asked for, and passes it the outcome.
    pub fn store<C, A, const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize>(
        &mut self,
        runner: &mut impl Mutex<T = Runner<C, A, TPDOS, RPDOS, PRODUCERS>>,
    ) where
        C: Peripheral,
        A: Application,
    {
        Task::STORE.answer();
        let mut parameters = [0; STORED_LEN];
        let persistent = self.log.parameters();
        let Some((settings, len)) =
            runner.lock(|runner| runner.take_store(persistent, &mut parameters))
        else {
            return;
        };
        let parameters = parameters.get(..len).unwrap_or_default();
        let outcome = self.log.store_with_parameters(settings, parameters);
        runner.lock(|runner| runner.handle_stored(outcome.map_err(StoreError::from)));
        match outcome {
            Ok(()) => defmt::info!("settings stored"),
            Err(error) => {
                defmt::error!("the settings were not stored, the old ones stay: {}", error);
            }
        }
    }
}
