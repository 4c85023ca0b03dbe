//! The board NUCLEO-L476RG with the 8 MHz of its ST-LINK: clocks, pins, and the place of the settings. It is only built.

use embassy_stm32::{
    Config, Peripherals,
    can::Can,
    flash::{Bank1Region, Blocking, Flash},
    gpio::{Level, Output, Speed},
    pac::{DBGMCU, FLASH, RCC},
    rcc::{self, APBPrescaler, Hse, HseMode, Pll, PllMul, PllPreDiv, PllRDiv, PllSource, Sysclk},
    time::Hertz,
};

pub use embassy_stm32::peripherals::IWDG as Watchdog;

use crate::{
    Parts,
    bxcan::{Bxcan, Interrupts},
    clock::Clock,
};

/// The clock of the CAN controller: 40 MHz makes all rates exactly.
pub const CAN_HZ: u32 = 40_000_000;

/// The last eight pages of the first bank.
pub const SETTINGS_OFFSET: u32 = 0x7_C000;
pub const SETTINGS_LEN: u32 = 0x4000;

/// 80 MHz, and 40 MHz for the peripherals.
pub fn clocks() -> Config {
    let mut config = Config::default();
    config.rcc.hse = Some(Hse { freq: Hertz(8_000_000), mode: HseMode::Bypass });
    config.rcc.pll = Some(Pll {
        source: PllSource::HSE,
        prediv: PllPreDiv::DIV1,
        mul: PllMul::MUL20,
        divp: None,
        divq: None,
        divr: Some(PllRDiv::DIV2),
    });
    config.rcc.sys = Sysclk::PLL1_R;
    config.rcc.apb1_pre = APBPrescaler::DIV2;
    config
}

/// Whether the PLL makes the clocks from the crystal as configured.
pub fn is_in_use(config: &rcc::Config) -> bool {
    let set = RCC.pllcfgr().read();
    RCC.cfgr().read().sws() == config.sys
        && config.pll.is_some_and(|pll| {
            (set.pllsrc(), set.pllm(), set.plln()) == (pll.source, pll.prediv, pll.mul)
                && Some(set.pllr()) == pll.divr
        })
}

/// Lets the watchdog and the timer of embassy's clock stand still while a debugger halts the core.
pub fn freeze_in_a_halt() {
    DBGMCU.apb1fzr1().modify(|w| w.set_iwdg(true));
    DBGMCU.apb2fzr().modify(|w| w.set_tim15(true));
}

/// Clears the flag of a double error in the flash. Returns whether it was set.
pub fn clear_double_error() -> bool {
    let found = FLASH.eccr().read();
    FLASH.eccr().write_value(found);
    found.eccd()
}

/// The peripherals that the node uses.
pub fn parts(p: Peripherals) -> Parts<Bxcan, Bank1Region<'static, Blocking>> {
    // embassy-stm32 0.6.0 does not reset the data cache behind an erase.
    FLASH.acr().modify(|w| w.set_dcen(false));
    Parts {
        can: Bxcan::new(Can::new(p.CAN1, p.PB8, p.PB9, Interrupts)),
        flash: Flash::new_blocking(p.FLASH).into_blocking_regions().bank1_region,
        run: Output::new(p.PA5, Level::Low, Speed::Low),
        error: Output::new(p.PA6, Level::Low, Speed::Low),
        clock: Clock::new(p.TIM2),
    }
}
