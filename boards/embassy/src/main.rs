//! The node on embassy-stm32: async drivers and one task.

#![no_std]
#![no_main]

#[cfg(feature = "bxcan")]
mod bxcan;
mod chip;
mod clock;
mod crystal;
mod device;
#[cfg(feature = "fdcan")]
mod fdcan;

use core::cell::RefCell;

use canopen_node::{
    Node,
    lss::Address,
    runner::{self, Runner},
    settings::Log,
};
use defmt_rtt as _;
use embassy_embedded_hal::flash::partition::BlockingPartition;
use embassy_executor::Spawner;
use embassy_futures::select::select;
use embassy_stm32::{gpio::Output, uid::uid, wdg::IndependentWatchdog};
use embassy_sync::blocking_mutex::{Mutex, NoopMutex};
use panic_probe as _;

use clock::Clock;

/// The time-outs of the watchdog: for the start, which may erase the settings' flash, and for a step of the node.
const START_US: u32 = 20_000_000;
const STEP_US: u32 = 2_000_000;

/// What the node needs of the chip.
struct Parts<C, F> {
    can: C,
    flash: F,
    run: Output<'static>,
    error: Output<'static>,
    clock: Clock,
}

/// Starts the watchdog, or changes its time-out.
fn watch(timeout_us: u32) -> IndependentWatchdog<'static, chip::Watchdog> {
    // SAFETY: nothing else uses it. embassy-stm32 hands it out after its wait for the clocks, which it shall watch.
    let mut watchdog = IndependentWatchdog::new(unsafe { chip::Watchdog::steal() }, timeout_us);
    watchdog.unleash();
    watchdog
}

#[embassy_executor::main]
async fn main(_spawner: Spawner) {
    chip::freeze_in_a_halt();
    watch(START_US);
    let clocks = chip::clocks();
    crystal::start(&clocks.rcc);
    let peripherals = embassy_stm32::init(clocks);
    crystal::check(&clocks.rcc);
    let Parts { can, flash, mut run, mut error, clock } = chip::parts(peripherals);
    let flash: NoopMutex<_> = Mutex::new(RefCell::new(flash));
    let settings = BlockingPartition::new(&flash, chip::SETTINGS_OFFSET, chip::SETTINGS_LEN);
    // It may erase, so the node joins the bus later.
    let (mut log, found) = Log::<_, { <Node>::STORED_LEN }>::open_with_parameters(settings);
    let device = device::DEVICE.with_serial_number(Address::serial_number_of(&uid()));
    let mut node = Node::new(device, log.settings());
    defmt::info!("settings: {}", runner::restore(&mut node, &mut log, found));
    let mut runner = Runner::new(node, can, clock);
    let mut watchdog = watch(STEP_US);
    loop {
        let wake = runner.poll(&mut log);
        if let Some(lit) = wake.lit {
            run.set_level(lit.run.into());
            error.set_level(lit.error.into());
            watchdog.pet();
        }
        let (can, clock) = runner.parts_mut();
        select(can.changed(), clock.wait_until(wake.at)).await;
    }
}
