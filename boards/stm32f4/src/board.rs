//! The board after a reset: watchdog, clocks, supply, settings and identity.

use canopen_node::{
    Application, Device, Node, NodeId,
    emergency::{Fault, Restart},
    lss::Address,
    runner,
    settings::Log,
};
use stm32f4xx_hal::{
    gpio::{ErasedPin, Input},
    pac::{DBGMCU, FLASH, IWDG, PWR, RCC, TIM2},
    rcc::{Config, Rcc, RccExt},
    time::Hertz,
};

#[cfg(feature = "update")]
use crate::mailbox;
use crate::{
    can::{CanPins, Controller, Peripheral},
    chip::{APB1_HZ, SYSCLK_HZ, UNIQUE_ID},
    clock::Alarm,
    crystal::{self, Crystal},
    fault,
    flash::{self, SettingsFlash},
    pll,
    reset::Reset,
    runner::{Runner, Storage},
    start,
    supply::Supply,
    watchdog::Watchdog,
};

/// The peripherals that the board uses. All others are the product's.
pub struct Peripherals {
    pub debug: DBGMCU,
    pub flash: FLASH,
    pub power: PWR,
    pub clocks: RCC,
    pub timer: TIM2,
    pub watchdog: IWDG,
}

/// The board with its clocks running.
pub struct Board {
    /// The clocks, for the peripherals of the product.
    pub rcc: Rcc,
    /// The watchdog, for tasks of the product that it shall wait for.
    pub watchdog: Watchdog,
    /// The timer's alarm, for a program without a node.
    pub alarm: Alarm,
    /// The flash for the settings log, for a program without a node.
    pub flash: SettingsFlash,
    /// Why the firmware was reset, if it has failed.
    pub(crate) restart: Option<Restart>,
}

impl Board {
    /// Sets the board up. The watchdog starts first, so that a hang in the set-up ends in a reset.
    pub fn new(chip: Peripherals, core: &cortex_m::Peripherals, crystal: Crystal) -> Self {
        let reset = Reset::take(&chip.clocks);
        Self::with_clocks(chip, core, crystal, reset, |clocks| {
            crystal::compare(crystal, &clocks);
            // The HAL takes the clock of the PLL for that of the crystal, and leaves the PLL itself to us.
            clocks.freeze(Config::hse(Hertz::from_raw(SYSCLK_HZ)).pclk1(Hertz::from_raw(APB1_HZ)))
        })
    }

    /// The same after this reset, with this way to the HAL's clocks.
    pub(crate) fn with_clocks(
        chip: Peripherals,
        core: &cortex_m::Peripherals,
        crystal: Crystal,
        reset: Reset,
        freeze: impl FnOnce(RCC) -> Rcc,
    ) -> Self {
        start::restore(core, &chip.clocks, &chip.flash);
        fault::guard_stack(&core.MPU);
        let watchdog = Watchdog::start(chip.watchdog, chip.debug);
        reset.log();
        let supply = Supply::wait(chip.power);
        crystal::start(crystal, &chip.clocks);
        let mut rcc = freeze(chip.clocks);
        pll::run_from(pll::FROM_CRYSTAL | (crystal.hz / 1_000_000), &rcc);
        crystal::check(crystal, &rcc);
        let alarm = Alarm::new(chip.timer, &mut rcc);
        let flash = SettingsFlash::new(chip.flash, supply);
        Self { rcc, watchdog, alarm, flash, restart: reset.failure }
    }

    /// Starts the node of this device with its stored settings and parameters, or the defaults, and joins the bus.
    pub fn start<C: Peripheral, A: Application, const STORED_LEN: usize>(
        mut self,
        device: Device,
        application: A,
        can: C,
        pins: CanPins<C>,
    ) -> (Runner<C, A>, Storage<STORED_LEN>, Watchdog) {
        const {
            assert!(
                Node::<A>::STORED_LEN <= flash::CAPACITY,
                "the flash has no room for the stored parameters of the application"
            );
        }
        let (mut log, found) = Log::open_with_parameters(self.flash);
        let stored = log.settings();
        let mut node = Node::with_application(device, stored, application);
        let found = runner::restore(&mut node, &mut log, found);
        #[cfg(feature = "update")]
        if let Some(in_force) = mailbox::take_in_force() {
            node = node.with_in_force(in_force.settings, in_force.heartbeat_ms);
        }
        crate::log::found(found, &stored.unwrap_or(device.defaults));
        if let Some(restart) = self.restart {
            node.handle_fault(Fault::Restarted(restart));
        }
        let can = Controller::new(can, pins, &mut self.rcc);
        // The start may have erased a sector, so the first roll call comes later.
        self.watchdog.feed();
        self.watchdog.call::<C>();
        (Runner::new(node, can, self.alarm), Storage { log }, self.watchdog)
    }
}

/// The node-ID of switches to ground, that for bit 0 first; a closed switch is a 1. `None` if all are open.
pub fn node_id(switches: &[ErasedPin<Input>]) -> Option<NodeId> {
    // Longer than a pull-up needs for the wires to the switches.
    cortex_m::asm::delay(SYSCLK_HZ / 10_000);
    NodeId::new(switches.iter().rev().fold(0, |bits, switch| bits << 1 | u8::from(switch.is_low())))
}

/// The serial number, derived from the chip's unique id.
pub fn serial_number() -> u32 {
    const ID: *const [u8; 12] = UNIQUE_ID as *const _;
    // SAFETY: read-only memory of every STM32F4.
    Address::serial_number_of(&unsafe { ID.read() })
}
