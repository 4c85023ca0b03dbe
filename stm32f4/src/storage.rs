//! The settings and parameters in the flash, and the task that stores them.

use canopen_node::{
    Application,
    lss::StoreError,
    settings::{Found, Log},
};
use rtic_core::Mutex;
use stm32f4xx_hal::pac::Interrupt;

use crate::{can::Peripheral, flash::SettingsFlash, runner::Runner, watchdog::Task};

/// The interrupt of the task that stores, which belongs to an unused USART. [`Runner`] triggers it.
pub(crate) const INTERRUPT: Interrupt = Interrupt::USART1;

/// The log in the flash. `STORED_LEN` is [`Node::STORED_LEN`](canopen_node::Node::STORED_LEN).
pub struct Storage<const STORED_LEN: usize> {
    log: Log<SettingsFlash, STORED_LEN>,
}

impl<const STORED_LEN: usize> Storage<STORED_LEN> {
    pub(crate) fn open(flash: SettingsFlash) -> (Self, Found) {
        let (log, found) = Log::open_with_parameters(flash);
        (Self { log }, found)
    }

    pub(crate) fn log(&mut self) -> &mut Log<SettingsFlash, STORED_LEN> {
        &mut self.log
    }

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
