//! The board STM32F407G-DISC1 with its crystal of 8 MHz, and NUCLEO-F767ZI with the 8 MHz of its ST-LINK, which is only
//! built: clocks, pins, and the place of the settings.

use embassy_stm32::{
    Config, Peripherals,
    can::Can,
    flash::{Bank1Region1, Blocking, Flash},
    gpio::{Level, Output, Speed},
    pac::{DBGMCU, RCC},
    rcc::{
        self, AHBPrescaler, APBPrescaler, Hse, HseMode, Pll, PllMul, PllPDiv, PllPreDiv, PllSource,
        Sysclk,
    },
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

const IS_F767: bool = cfg!(feature = "stm32f767");

/// Sectors 1 and 2, each as long as sector 0.
pub const SETTINGS_OFFSET: u32 = if IS_F767 { 0x8000 } else { 0x4000 };
pub const SETTINGS_LEN: u32 = 2 * SETTINGS_OFFSET;

/// 160 MHz from the 8 MHz, and 40 MHz for the peripherals.
pub fn clocks() -> Config {
    let mut config = Config::default();
    let mode = if IS_F767 { HseMode::Bypass } else { HseMode::Oscillator };
    config.rcc.hse = Some(Hse { freq: Hertz(8_000_000), mode });
    config.rcc.pll_src = PllSource::HSE;
    config.rcc.pll = Some(Pll {
        prediv: PllPreDiv::DIV4,
        mul: PllMul::MUL160,
        divp: Some(PllPDiv::DIV2),
        divq: None,
        divr: None,
    });
    config.rcc.sys = Sysclk::PLL1_P;
    config.rcc.ahb_pre = AHBPrescaler::DIV1;
    config.rcc.apb1_pre = APBPrescaler::DIV4;
    config.rcc.apb2_pre = APBPrescaler::DIV2;
    config
}

/// Whether the PLL makes the clocks from the crystal as configured.
pub fn is_in_use(config: &rcc::Config) -> bool {
    let set = RCC.pllcfgr().read();
    RCC.cfgr().read().sws() == config.sys
        && set.pllsrc() == config.pll_src
        && config.pll.is_some_and(|pll| {
            (set.pllm(), set.plln(), Some(set.pllp())) == (pll.prediv, pll.mul, pll.divp)
        })
}

/// Lets the watchdog and the timer of embassy's clock stand still while a debugger halts the core.
pub fn freeze_in_a_halt() {
    DBGMCU.apb1fzr().modify(|w| {
        w.set_iwdg(true);
        w.set_tim12(true);
    });
}

/// The flash has no error-correcting code.
pub fn clear_double_error() -> bool {
    false
}

/// The peripherals that the node uses.
pub fn parts(p: Peripherals) -> Parts<Bxcan, Bank1Region1<'static, Blocking>> {
    #[cfg(feature = "stm32f407")]
    let (receive, transmit, run, error) = (p.PB8, p.PB9, p.PD12, p.PD14);
    #[cfg(feature = "stm32f767")]
    let (receive, transmit, run, error) = (p.PD0, p.PD1, p.PB0, p.PB14);
    Parts {
        can: Bxcan::new(Can::new(p.CAN1, receive, transmit, Interrupts)),
        flash: Flash::new_blocking(p.FLASH).into_blocking_regions().bank1_region1,
        run: Output::new(run, Level::Low, Speed::Low),
        error: Output::new(error, Level::Low, Speed::Low),
        clock: Clock::new(p.TIM2),
    }
}
