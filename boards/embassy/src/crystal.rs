//! The crystal: its start, and the reset if it does not start or is not in use. embassy-stm32 would wait
//! for it without a limit, and does not look at the clock that comes of it.

use cortex_m::peripheral::SCB;
use embassy_stm32::{
    pac::RCC,
    rcc::{Config, HSI_FREQ, HseMode},
};

use crate::chip;

/// The register reads of at least 100 ms, at five cycles each: after a reset the core has HSI, or is slower.
const READS: u32 = HSI_FREQ.0 / 50;

/// Starts the crystal, and resets the chip if it does not start: embassy-stm32 would wait for it without a limit.
pub fn start(config: &Config) {
    let is_external_clock = config.hse.is_some_and(|hse| hse.mode == HseMode::Bypass);
    RCC.cr().modify(|w| w.set_hsebyp(is_external_clock));
    RCC.cr().modify(|w| w.set_hseon(true));
    if !(0..READS).any(|_| RCC.cr().read().hserdy()) {
        defmt::error!(
            "the crystal does not start, resetting: is it that of the board in src/chip/?"
        );
        give_up(READS);
    }
}

/// Resets the chip unless the PLL makes the clocks from the crystal as configured: at any other clock the bit rates are
/// wrong.
pub fn check(config: &Config) {
    if !chip::is_in_use(config) {
        defmt::error!("the clock is not that of the crystal, resetting");
        // The core may run ten times as fast.
        give_up(10 * READS);
    }
}

/// Resets the chip, after 100 ms in which a probe fetches the log: it looks every 10 to 100 ms.
fn give_up(reads: u32) -> ! {
    for _ in 0..reads {
        RCC.cr().read();
    }
    SCB::sys_reset();
}
