//! The node on its board, and the stores.

use canopen_node::{
    Application, Instant,
    lss::StoreError,
    runner::{self, System},
    settings::Log,
};
use cortex_m::peripheral::NVIC;
use rtic_core::Mutex;

use crate::{
    can::{Controller, Peripheral},
    clock::{self, Alarm},
    flash::SettingsFlash,
    task::Task,
    watchdog,
};

/// The node, its controller, and their next deadline. Each interrupt calls one of its `handle_` functions.
pub type Runner<C, A> = runner::Runner<Controller<C>, Alarm, A>;

impl System for Alarm {
    #[inline(always)] // It reads a register.
    fn now(&self) -> Instant {
        clock::now()
    }

    fn reset(&mut self) {
        #[cfg(feature = "update")]
        crate::mailbox::reset();
        #[cfg(not(feature = "update"))]
        crate::reset::end_by_command();
    }

    fn set_alarm(&mut self, at: Instant) {
        self.set(at);
    }

    fn begin_store(&mut self) {
        NVIC::pend(watchdog::STORE);
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
        let stored = outcome.map(|()| parameters).map_err(StoreError::from);
        runner.lock(|runner| runner.handle_stored(stored));
        match outcome {
            Ok(()) => defmt::info!("settings stored"),
            Err(error) => {
                defmt::error!("the settings were not stored, the old ones stay: {}", error);
            }
        }
    }
}
