//! The PLL as the core's clock, with wait states for every supply from 2.1 V on. The HAL's are for 2.7 V.

use stm32f4xx_hal::pac::{FLASH, RCC};

use crate::{chip::SYSCLK_HZ, start::comes_in_100_ms};

/// The clock of the PLL's oscillator in MHz, made from 1 MHz (RM0090, 7.3.2).
const OSCILLATOR_MHZ: u32 = 320;
const SYSCLK_MHZ: u32 = SYSCLK_HZ / 1_000_000;
/// RCC_PLLCFGR: M, N, P, and the crystal as the source.
const MASK: u32 = 1 << 22 | 3 << 16 | 0x7FFF;
const N_AND_P: u32 = (OSCILLATOR_MHZ / SYSCLK_MHZ / 2 - 1) << 16 | OSCILLATOR_MHZ << 6;
pub const FROM_CRYSTAL: u32 = 1 << 22;
/// The internal oscillator as the source, 16 MHz.
#[cfg(feature = "update")]
pub const FROM_HSI: u32 = 16;
/// RCC_CFGR: the PLL as the system clock; APB1 at 40 MHz, and APB2 at 80 MHz (RM0090, 7.3.3).
const CFGR: u32 = match SYSCLK_MHZ {
    160 => 0b100 << 13 | 0b101 << 10 | 0b10,
    _ => 0b100 << 10 | 0b10,
};
/// The wait states for 160 MHz at 2.1 V (RM0090, table 10). At 80 MHz it is more than enough.
const WAIT_STATES: u8 = 7;

/// Lets the core run from the PLL with this source, and the MHz of it.
pub fn run_from(source: u32, clocks: &RCC) {
    // SAFETY: the settings are within the limits of each chip. Nothing else uses the flash.
    unsafe {
        clocks.pllcfgr().modify(|r, w| w.bits(r.bits() & !MASK | source | N_AND_P));
        clocks.cr().modify(|_, w| w.pllon().set_bit());
        comes_in_100_ms(|| clocks.cr().read().pllrdy().bit_is_set());
        let flash = FLASH::steal();
        flash.acr().modify(|_, w| w.prften().set_bit().latency().bits(WAIT_STATES));
        // Only then they are in force (RM0090, 3.5.1).
        comes_in_100_ms(|| flash.acr().read().latency().bits() == WAIT_STATES);
        clocks.cfgr().write(|w| w.bits(CFGR));
    }
}
