//! An STM32G431 with a crystal of 8 MHz: clocks, pins, and the place of the settings.

use embassy_stm32::{
    Config, Peripherals,
    flash::{Bank1Region, Blocking, Flash},
    gpio::{Level, Output, Speed},
    rcc::{Hse, HseMode, Pll, PllMul, PllPreDiv, PllQDiv, PllRDiv, PllSource, Sysclk, mux},
    time::Hertz,
    wdg::IndependentWatchdog,
};

use crate::{Parts, fdcan::Fdcan};

/// The clock of the CAN controller: 80 MHz makes all rates exactly.
pub const CAN_HZ: u32 = 80_000_000;

/// The last eight pages of 2 KB.
pub const SETTINGS_OFFSET: u32 = 0x1_C000;
pub const SETTINGS_LEN: u32 = 0x4000;

/// 80 MHz, for FDCAN too: `boost` of embassy-stm32 0.6.0, for more than 150 MHz, sets the wrong bit.
pub fn clocks() -> Config {
    let mut config = Config::default();
    config.rcc.hse = Some(Hse { freq: Hertz(8_000_000), mode: HseMode::Oscillator });
    config.rcc.hsi48 = None;
    config.rcc.pll = Some(Pll {
        source: PllSource::HSE,
        prediv: PllPreDiv::DIV2,
        mul: PllMul::MUL80,
        divp: None,
        divq: Some(PllQDiv::DIV4),
        divr: Some(PllRDiv::DIV4),
    });
    config.rcc.sys = Sysclk::PLL1_R;
    config.rcc.mux.fdcansel = mux::Fdcansel::PLL1_Q;
    config
}

/// The peripherals that the node uses.
pub fn parts(p: Peripherals) -> Parts<Fdcan, Bank1Region<'static, Blocking>> {
    Parts {
        can: Fdcan::new(p.FDCAN1, p.PB8, p.PB9),
        flash: Flash::new_blocking(p.FLASH).into_blocking_regions().bank1_region,
        run: Output::new(p.PC13, Level::Low, Speed::Low),
        error: Output::new(p.PC14, Level::Low, Speed::Low),
        watchdog: IndependentWatchdog::new(p.IWDG, 2_000_000),
    }
}
