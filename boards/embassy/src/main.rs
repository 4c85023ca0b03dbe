//! The node on embassy-stm32: async drivers and one task.

#![no_std]
#![no_main]

#[cfg(feature = "bxcan")]
mod bxcan;
mod chip;
mod device;
#[cfg(feature = "fdcan")]
mod fdcan;

use core::cell::RefCell;

use canopen_node::{
    Instant, Node,
    lss::Address,
    runner::{self, AsyncSystem, Runner, System},
    settings::Log,
};
use defmt_rtt as _;
use embassy_embedded_hal::flash::partition::BlockingPartition;
use embassy_executor::Spawner;
use embassy_stm32::{gpio::Output, uid::uid, wdg::IndependentWatchdog};
use embassy_sync::blocking_mutex::{Mutex, NoopMutex};
use embassy_time::Timer;
use panic_probe as _;

/// What the node needs of the chip.
struct Parts<C, F> {
    can: C,
    flash: F,
    run: Output<'static>,
    error: Output<'static>,
    watchdog: IndependentWatchdog<'static, chip::Watchdog>,
}

/// The time driver of embassy, and the core.
struct Core;

impl System for Core {
    fn now(&self) -> Instant {
        Instant::from_micros(embassy_time::Instant::now().as_micros() as u32)
    }

    fn reset(&mut self) {
        cortex_m::peripheral::SCB::sys_reset();
    }
}

impl AsyncSystem for Core {
    async fn wait_until(&mut self, at: Instant) {
        Timer::after_micros(at.micros_after(self.now()).into()).await;
    }
}

#[embassy_executor::main]
async fn main(_spawner: Spawner) {
    let Parts { can, flash, mut run, mut error, mut watchdog } =
        chip::parts(embassy_stm32::init(chip::clocks()));
    let flash: NoopMutex<_> = Mutex::new(RefCell::new(flash));
    let settings = BlockingPartition::new(&flash, chip::SETTINGS_OFFSET, chip::SETTINGS_LEN);
    // It may erase, so the node joins the bus later.
    let (mut log, found) = Log::<_, { <Node>::STORED_LEN }>::open_with_parameters(settings);
    let device = device::DEVICE.with_serial_number(Address::serial_number_of(&uid()));
    let mut node = Node::new(device, log.settings());
    defmt::info!("settings: {}", runner::restore(&mut node, &mut log, found));
    let mut runner = Runner::new(node, can, Core);
    watchdog.unleash();
    loop {
        let lit = runner.run_step(&mut log).await;
        run.set_level(lit.run.into());
        error.set_level(lit.error.into());
        watchdog.pet();
    }
}
