//! The clocks of the loader, which has no room for the HAL's search of a setting: those that `Board::new` makes too.

use stm32f4xx_hal::{
    pac::{FLASH, RCC},
    rcc::{Rcc, RccExt},
};

use crate::{chip::SYSCLK_HZ, crystal::Crystal, start::comes_in_100_ms};

/// The clock of the PLL's oscillator in MHz, made from 1 MHz (RM0090, 7.3.2).
const OSCILLATOR_MHZ: u32 = 320;
const SYSCLK_MHZ: u32 = SYSCLK_HZ / 1_000_000;
/// RCC_PLLCFGR: M, N, P, and the crystal as the source.
const MASK: u32 = 1 << 22 | 3 << 16 | 0x7FFF;
const N_AND_P: u32 = (OSCILLATOR_MHZ / SYSCLK_MHZ / 2 - 1) << 16 | OSCILLATOR_MHZ << 6;
const FROM_CRYSTAL: u32 = 1 << 22;
/// The internal oscillator as the source, 16 MHz.
pub(super) const FROM_HSI: u32 = 16;
/// RCC_CFGR: the PLL as the system clock; APB1 at 40 MHz, and APB2 at 80 MHz (RM0090, 7.3.3).
const CFGR: u32 = match SYSCLK_MHZ {
    160 => 0b100 << 13 | 0b101 << 10 | 0b10,
    _ => 0b100 << 10 | 0b10,
};
/// FLASH_ACR: prefetch, and the wait states at 2.7 V and more, one for each 30 MHz, or 25 on some chips of 100 MHz.
const ACR: u32 = 1 << 8 | if SYSCLK_MHZ == 160 { 5 } else { 3 };

/// Lets the core run from the PLL, once the crystal runs.
pub fn start(crystal: Crystal, clocks: RCC) -> Rcc {
    run_from(FROM_CRYSTAL | (crystal.hz / 1_000_000), &clocks);
    // Whether it is so, `crystal::check` sees.
    clocks.constrain()
}

/// Lets the core run from the PLL with this source, and the MHz of it.
pub(super) fn run_from(source: u32, clocks: &RCC) {
    // SAFETY: the settings are within the limits of each chip. Nothing else uses the flash.
    unsafe {
        clocks.pllcfgr().modify(|r, w| w.bits(r.bits() & !MASK | source | N_AND_P));
        clocks.cr().modify(|_, w| w.pllon().set_bit());
        comes_in_100_ms(|| clocks.cr().read().pllrdy().bit_is_set());
        FLASH::steal().acr().write(|w| w.bits(ACR));
        clocks.cfgr().write(|w| w.bits(CFGR));
    }
}
