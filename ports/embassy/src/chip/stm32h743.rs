//! The board NUCLEO-H743ZI: clocks, pins, and the place of the settings. Built only.

use embassy_stm32::{
    Config, Peripherals,
    flash::{Bank2Region, Blocking, Flash},
    gpio::{Level, Output, Speed},
    rcc::{
        AHBPrescaler, APBPrescaler, Hse, HseMode, Pll, PllDiv, PllMul, PllPreDiv, PllSource,
        Sysclk, mux,
    },
    time::Hertz,
    wdg::IndependentWatchdog,
};

use crate::{Parts, fdcan::Fdcan};

/// The clock of the CAN controller: 80 MHz makes all rates exactly.
pub const CAN_HZ: u32 = 80_000_000;

/// The last two sectors of 128 KB of bank 2: the program, in bank 1, runs while they are written.
pub const SETTINGS_OFFSET: u32 = 0xC_0000;
pub const SETTINGS_LEN: u32 = 0x4_0000;

/// 400 MHz from the 8 MHz of the ST-LINK, and 80 MHz for FDCAN.
pub fn clocks() -> Config {
    let mut config = Config::default();
    config.rcc.hse = Some(Hse { freq: Hertz(8_000_000), mode: HseMode::Bypass });
    config.rcc.pll1 = Some(Pll {
        source: PllSource::HSE,
        prediv: PllPreDiv::DIV1,
        mul: PllMul::MUL100,
        fracn: None,
        divp: Some(PllDiv::DIV2),
        divq: Some(PllDiv::DIV10),
        divr: None,
    });
    config.rcc.sys = Sysclk::PLL1_P;
    config.rcc.ahb_pre = AHBPrescaler::DIV2;
    config.rcc.apb1_pre = APBPrescaler::DIV2;
    config.rcc.apb2_pre = APBPrescaler::DIV2;
    config.rcc.apb3_pre = APBPrescaler::DIV2;
    config.rcc.apb4_pre = APBPrescaler::DIV2;
    config.rcc.mux.fdcansel = mux::Fdcansel::PLL1_Q;
    config
}

/// The peripherals that the node uses.
pub fn parts(p: Peripherals) -> Parts<Fdcan, Bank2Region<'static, Blocking>> {
    Parts {
        can: Fdcan::new(p.FDCAN1, p.PB8, p.PB9),
        flash: Flash::new_blocking(p.FLASH).into_blocking_regions().bank2_region,
        run: Output::new(p.PB0, Level::Low, Speed::Low),
        error: Output::new(p.PB14, Level::Low, Speed::Low),
        watchdog: IndependentWatchdog::new(p.IWDG1, 2_000_000),
    }
}
