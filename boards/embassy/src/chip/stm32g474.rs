//! The board NUCLEO-G474RE with its crystal of 24 MHz: clocks, pins, and the place of the settings. It is only built.

use embassy_stm32::{
    Config, Peripherals,
    flash::{Bank2Region, Blocking, Flash},
    gpio::{Level, Output, Speed},
    peripherals::{PA11, PA12},
    rcc::{Hse, HseMode, Pll, PllMul, PllPreDiv, PllQDiv, PllRDiv, PllSource, Sysclk, mux},
    time::Hertz,
};

use crate::{Parts, clock::Clock, fdcan::Fdcan};

/// The pins of the CAN controller. PB8 would be BOOT0, which a transceiver holds high at each reset.
pub type Receive = PA11;
pub type Transmit = PA12;

/// The clock of the CAN controller: 80 MHz makes all rates exactly.
pub const CAN_HZ: u32 = 80_000_000;

/// The last eight pages of 2 KB in bank 2: the program, in bank 1, runs while they are written.
pub const SETTINGS_OFFSET: u32 = 0x3_C000;
pub const SETTINGS_LEN: u32 = 0x4000;

/// 80 MHz, for FDCAN too.
pub fn clocks() -> Config {
    let mut config = Config::default();
    config.rcc.hse = Some(Hse { freq: Hertz(24_000_000), mode: HseMode::Oscillator });
    config.rcc.hsi48 = None;
    config.rcc.pll = Some(Pll {
        source: PllSource::HSE,
        prediv: PllPreDiv::DIV6,
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
pub fn parts(p: Peripherals) -> Parts<Fdcan, Bank2Region<'static, Blocking>> {
    Parts {
        can: Fdcan::new(p.FDCAN1, p.PA11, p.PA12),
        flash: Flash::new_blocking(p.FLASH).into_blocking_regions().bank2_region,
        run: Output::new(p.PA5, Level::Low, Speed::Low),
        error: Output::new(p.PA6, Level::Low, Speed::Low),
        clock: Clock::new(p.TIM2),
    }
}
