//! The node on its board: what each interrupt calls, and the stores.

use canopen_node::{
    Application, Instant, Node, Settings,
    indicator::Lit,
    lss::StoreError,
    runner::{self, System},
    settings::Log,
};
#[cfg(feature = "update")]
use canopen_node::{Confirmation, sdo::Abort};
use cortex_m::peripheral::{NVIC, SCB};
use rtic_core::Mutex;

use crate::{
    can::{Controller, Peripheral},
    clock::{self, Alarm},
    flash::{self, SettingsFlash},
    watchdog::{self, Task},
};

/// The node, its controller, and their next deadline.
pub struct Runner<C: Peripheral, A: Application> {
    runner: runner::Runner<Controller<C>, Board, A>,
}

/// What the runner needs beside the controller.
struct Board {
    alarm: Alarm,
}

impl System for Board {
    #[inline(always)] // It reads a register.
    fn now(&self) -> Instant {
        clock::now()
    }

    fn reset(&mut self) {
        #[cfg(feature = "update")]
        crate::update::note_reset();
        SCB::sys_reset();
    }

    fn set_alarm(&mut self, at: Instant) {
        self.alarm.set(at);
    }

    fn begin_store(&mut self) {
        NVIC::pend(watchdog::STORE);
    }
}

impl<C: Peripheral, A: Application> Runner<C, A> {
    /// A node after power-on, and its controller, which takes part in the bus from now on, unless the node wants to
    /// listen first.
    pub fn new(node: Node<A>, can: Controller<C>, alarm: Alarm) -> Self {
        const {
            assert!(
                Node::<A>::STORED_LEN <= flash::CAPACITY,
                "the flash has no room for the stored parameters of the application"
            );
        }
        Self { runner: runner::Runner::new(node, can, Board { alarm }) }
    }

    /// Handles received frames.
    pub fn handle_received(&mut self) {
        self.runner.handle_received();
        Task::RECEIVED.answer();
    }

    /// Handles frames that were sent or aborted.
    pub fn handle_transmitted(&mut self) {
        self.runner.handle_transmitted();
        Task::TRANSMITTED.answer();
    }

    /// Handles a change of the controller's error state, or an error on the bus.
    pub fn handle_status(&mut self) {
        self.runner.handle_status();
        Task::STATUS.answer();
    }

    /// Checks the controller, a few times a second: no interrupt reports its recovery from bus-off.
    pub fn supervise(&mut self) {
        self.runner.supervise();
    }

    /// Does what is due now; returns the indicators to light, at the start of each of their steps.
    pub fn handle_alarm(&mut self) -> Option<Lit> {
        self.runner.system_mut().alarm.acknowledge();
        self.runner.handle_alarm()
    }

    /// Reads or changes the application's values.
    pub fn application<R>(&mut self, access: impl FnOnce(&mut A) -> R) -> R {
        self.runner.application(access)
    }

    /// Reports an error of the application, as [`Node::report`] does.
    pub fn report(&mut self, code: u16, register: u8, information: [u8; 5]) -> bool {
        self.runner.report(code, register, information)
    }

    /// Ends an error of the application, as [`Node::end_report`] does.
    pub fn end_report(&mut self, code: u16) {
        self.runner.end_report(code);
    }

    /// Sends a TPDO though no value has changed, as [`Node::send_tpdo`] does.
    pub fn send_tpdo(&mut self, number: u8) {
        self.runner.send_tpdo(number);
    }

    /// The node.
    #[cfg(feature = "update")]
    pub(crate) fn node(&self) -> &Node<A> {
        self.runner.node()
    }

    /// The values of the application, where nothing follows from a change.
    #[cfg(feature = "update")]
    pub(crate) fn application_mut(&mut self) -> &mut A {
        self.runner.node_mut().application_mut()
    }

    /// Whether every frame of the node has been sent and acknowledged, or dropped.
    #[cfg(feature = "update")]
    pub(crate) fn is_idle(&mut self) -> bool {
        self.runner.is_idle()
    }

    /// Whether the controller is bus-off.
    #[cfg(feature = "update")]
    pub(crate) fn is_bus_off(&self) -> bool {
        self.runner.is_bus_off()
    }

    /// Answers an SDO download, as [`Node::answer`] does.
    #[cfg(feature = "update")]
    pub(crate) fn answer(&mut self, answer: Confirmation, outcome: Result<(), Abort>) {
        self.runner.answer(answer, outcome);
    }

    /// Refuses a store that was asked for.
    #[cfg(feature = "update")]
    pub(crate) fn refuse_store(&mut self, error: StoreError) {
        self.runner.refuse_store(error);
    }

    fn take_store(
        &mut self,
        persistent: &[u8],
        parameters: &mut [u8],
    ) -> Option<(Settings, usize)> {
        self.runner.take_store(persistent, parameters)
    }

    fn handle_stored(&mut self, outcome: Result<(), StoreError>) {
        self.runner.handle_stored(outcome);
    }
}

/// The log in the flash. `STORED_LEN` is [`Node::STORED_LEN`](canopen_node::Node::STORED_LEN).
pub struct Storage<const STORED_LEN: usize> {
    pub(crate) log: Log<SettingsFlash, STORED_LEN>,
}

impl<const STORED_LEN: usize> Storage<STORED_LEN> {
    /// Stores what the node has asked for, and passes it the outcome.
    pub fn store<C: Peripheral, A: Application>(
        &mut self,
        runner: &mut impl Mutex<T = Runner<C, A>>,
    ) {
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
