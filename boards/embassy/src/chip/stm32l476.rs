//! The board NUCLEO-L476RG with the 8 MHz of its ST-LINK: clocks, pins, and the place of the settings. It is only built.

use embassy_stm32::{
    Config, Peripherals,
    can::Can,
    flash::{Bank1Region, Blocking, Flash},
    gpio::{Level, Output, Speed},
    rcc::{APBPrescaler, Hse, HseMode, Pll, PllMul, PllPreDiv, PllRDiv, PllSource, Sysclk},
    time::Hertz,
};

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
