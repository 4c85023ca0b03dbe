//! A board of one's own with an STM32F105RC and a crystal of 8 MHz: clocks, pins, and the place of the settings. It is only
//! built.

use embassy_stm32::{
    Config, Peripherals,
    can::Can,
    flash::{Bank1Region, Blocking, Flash},
    gpio::{Level, Output, Speed},
    pac::{DBGMCU, RCC, rcc::vals::Pllsrc},
    rcc::{self, APBPrescaler, Hse, HseMode, Pll, PllMul, PllPreDiv, PllSource, Sysclk},
    time::Hertz,
};

pub use embassy_stm32::peripherals::IWDG as Watchdog;

use crate::{
    Parts,
    bxcan::{Bxcan, Interrupts},
    clock::Clock,
};

/// The clock of the CAN controller.
pub const CAN_HZ: u32 = 36_000_000;

/// The last eight pages.
pub const SETTINGS_OFFSET: u32 = 0x3_C000;
pub const SETTINGS_LEN: u32 = 0x4000;

/// 72 MHz, and 36 MHz for the peripherals.
pub fn clocks() -> Config {
    let mut config = Config::default();
    config.rcc.hse = Some(Hse { freq: Hertz(8_000_000), mode: HseMode::Oscillator });
    config.rcc.pll = Some(Pll { src: PllSource::HSE, prediv: PllPreDiv::DIV1, mul: PllMul::MUL9 });
    config.rcc.sys = Sysclk::PLL1_P;
    config.rcc.apb1_pre = APBPrescaler::DIV2;
    config
}

/// Whether the PLL makes the clocks from the crystal as configured.
pub fn is_in_use(config: &rcc::Config) -> bool {
    let (set, dividers) = (RCC.cfgr().read(), RCC.cfgr2().read());
    set.sws() == config.sys
        && set.pllsrc() == Pllsrc::HSE_DIV_PREDIV
        && config.pll.is_some_and(|pll| (set.pllmul(), dividers.prediv1()) == (pll.mul, pll.prediv))
}

/// Lets the watchdog and the timer of embassy's clock stand still while a debugger halts the core.
pub fn freeze_in_a_halt() {
    DBGMCU.cr().modify(|w| {
        w.set_iwdg(true);
        w.set_tim4(true);
    });
}

/// The flash has no error-correcting code.
pub fn clear_double_error() -> bool {
    false
}

/// The peripherals that the node uses.
pub fn parts(p: Peripherals) -> Parts<Bxcan, Bank1Region<'static, Blocking>> {
    Parts {
        can: Bxcan::new(Can::new(p.CAN1, p.PB8, p.PB9, Interrupts)),
        flash: Flash::new_blocking(p.FLASH).into_blocking_regions().bank1_region,
        run: Output::new(p.PA5, Level::Low, Speed::Low),
        error: Output::new(p.PA6, Level::Low, Speed::Low),
        clock: Clock::new(p.TIM2),
    }
}
