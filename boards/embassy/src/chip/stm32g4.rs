//! The boards NUCLEO-G431RB and NUCLEO-G474RE, which is only built, with their crystal of 24 MHz: clocks, pins, and the
//! place of the settings.

use embassy_stm32::{
    Config, Peripherals,
    flash::{Blocking, Flash},
    gpio::{Level, Output, Speed},
    pac::{DBGMCU, FLASH, RCC},
    peripherals::{PA11, PA12},
    rcc::{self, Hse, HseMode, Pll, PllMul, PllPreDiv, PllQDiv, PllRDiv, PllSource, Sysclk, mux},
    time::Hertz,
};

pub use embassy_stm32::peripherals::IWDG as Watchdog;

use crate::{Parts, clock::Clock, fdcan::Fdcan};

/// The pins of the CAN controller. PB8 would be BOOT0, which a transceiver holds high at each reset.
pub type Receive = PA11;
pub type Transmit = PA12;

/// The clock of the CAN controller: 80 MHz makes all rates exactly.
pub const CAN_HZ: u32 = 80_000_000;

#[cfg(feature = "stm32g431")]
pub type Region = embassy_stm32::flash::Bank1Region<'static, Blocking>;
#[cfg(feature = "stm32g474")]
pub type Region = embassy_stm32::flash::Bank2Region<'static, Blocking>;

/// The last eight pages of 2 KB. On the STM32G474 they are in bank 2: the program, in bank 1, runs while they are written.
pub const SETTINGS_OFFSET: u32 = if cfg!(feature = "stm32g431") { 0x1_C000 } else { 0x3_C000 };
pub const SETTINGS_LEN: u32 = 0x4000;

/// 80 MHz, for FDCAN too: `boost` of embassy-stm32 0.6.0, for more than 150 MHz, sets the wrong bit.
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

/// Whether the PLL makes the clocks from the crystal as configured.
pub fn is_in_use(config: &rcc::Config) -> bool {
    let set = RCC.pllcfgr().read();
    RCC.cfgr().read().sws() == config.sys
        && RCC.ccipr().read().fdcansel() == config.mux.fdcansel
        && config.pll.is_some_and(|pll| {
            (set.pllsrc(), set.pllm(), set.plln()) == (pll.source, pll.prediv, pll.mul)
                && (Some(set.pllq()), Some(set.pllr())) == (pll.divq, pll.divr)
        })
}

/// Lets the watchdog and the timer of embassy's clock stand still while a debugger halts the core.
pub fn freeze_in_a_halt() {
    DBGMCU.apb1lfzr().modify(|w| w.set_iwdg(true));
    DBGMCU.apb2fzr().modify(|w| w.set_tim15(true));
}

/// Clears the flag of a double error in the flash. Returns whether it was set.
pub fn clear_double_error() -> bool {
    /// ECCD, and ECCD2 of an STM32G474 whose flash is one bank of 128 bits.
    const DOUBLE_ERRORS: u32 = 1 << 31 | 1 << 29;
    let found = FLASH.eccr().read();
    FLASH.eccr().write_value(found);
    found.0 & DOUBLE_ERRORS != 0
}

/// The peripherals that the node uses.
pub fn parts(p: Peripherals) -> Parts<Fdcan, Region> {
    let regions = Flash::new_blocking(p.FLASH).into_blocking_regions();
    Parts {
        can: Fdcan::new(p.FDCAN1, p.PA11, p.PA12),
        #[cfg(feature = "stm32g431")]
        flash: regions.bank1_region,
        #[cfg(feature = "stm32g474")]
        flash: regions.bank2_region,
        run: Output::new(p.PA5, Level::Low, Speed::Low),
        error: Output::new(p.PA6, Level::Low, Speed::Low),
        clock: Clock::new(p.TIM2),
    }
}
