//! The board STM32F407G-DISC1 with its crystal of 8 MHz: clocks, pins, and the place of the settings.

use embassy_stm32::{
    Config, Peripherals,
    can::Can,
    flash::{Bank1Region1, Blocking, Flash},
    gpio::{Level, Output, Speed},
    rcc::{
        AHBPrescaler, APBPrescaler, Hse, HseMode, Pll, PllMul, PllPDiv, PllPreDiv, PllSource,
        Sysclk,
    },
    time::Hertz,
};

use crate::{
    Parts,
    bxcan::{Bxcan, Interrupts},
    clock::Clock,
};

/// The clock of the CAN controller: 40 MHz makes all rates exactly.
pub const CAN_HZ: u32 = 40_000_000;

/// Sectors 1 and 2.
pub const SETTINGS_OFFSET: u32 = 0x4000;
pub const SETTINGS_LEN: u32 = 0x8000;

/// 160 MHz from a crystal of 8 MHz, and 40 MHz for the peripherals.
pub fn clocks() -> Config {
    let mut config = Config::default();
    config.rcc.hse = Some(Hse { freq: Hertz(8_000_000), mode: HseMode::Oscillator });
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

/// The peripherals that the node uses.
pub fn parts(p: Peripherals) -> Parts<Bxcan, Bank1Region1<'static, Blocking>> {
    Parts {
        can: Bxcan::new(Can::new(p.CAN1, p.PB8, p.PB9, Interrupts)),
        flash: Flash::new_blocking(p.FLASH).into_blocking_regions().bank1_region1,
        run: Output::new(p.PD12, Level::Low, Speed::Low),
        error: Output::new(p.PD14, Level::Low, Speed::Low),
        clock: Clock::new(p.TIM2),
    }
}
