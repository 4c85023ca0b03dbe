//! The chip's supply, as measured by the programmable voltage detector (RM0090, 5.2.3).

use cortex_m::peripheral::SCB;
use stm32f4xx_hal::{pac::PWR, rcc::Enable};

use crate::start;

/// PLS for a falling supply of 2.13 to 2.25 V, depending on the chip, a rising one of 2.23 to 2.37 V (data sheet, VPVD1).
const ENOUGH_FOR_CLOCK: u8 = 0b001;
/// PLS for a falling supply of 2.75 to 2.92 V, a rising one of 2.86 to 2.99 V (VPVD5).
const ENOUGH_FOR_WORDS: u8 = 0b101;

/// The voltage detector.
pub struct Supply {
    detector: PWR,
}

impl Supply {
    /// Switches the detector on, and waits for the 2.1 V that the wait states of the clock need: up to 100 ms, or 400 ms
    /// with a line in the log, and then resets the chip.
    pub fn wait(detector: PWR) -> Self {
        // SAFETY: the enable bit of PWR in RCC belongs to its owner; no interrupt changes others yet.
        unsafe { PWR::enable_unchecked() };
        let supply = Self { detector };
        supply.compare_with(ENOUGH_FOR_CLOCK);
        let is_enough = || start::comes_in_100_ms(|| !supply.is_low());
        if !is_enough() {
            defmt::error!("the supply is below 2.1 V, which the clock needs: waiting for it");
            if !(0..3).any(|_| is_enough()) {
                SCB::sys_reset();
            }
        }
        supply.compare_with(ENOUGH_FOR_WORDS);
        supply
    }

    /// The detector, which is on, for one of several users.
    ///
    /// # Safety
    /// No other user interrupts this one.
    #[cfg(feature = "update")]
    pub unsafe fn steal() -> Self {
        // SAFETY: the caller sees to it.
        Self { detector: unsafe { PWR::steal() } }
    }

    fn compare_with(&self, level: u8) {
        self.detector.cr().modify(|_, w| w.pls().set(level).pvde().set_bit());
    }

    /// Whether the supply may be below the 2.7 V for programming the flash in words.
    pub fn is_low(&self) -> bool {
        self.detector.csr().read().pvdo().bit_is_set()
    }

    /// Whether it may be below the 2.1 V for programming in half-words.
    #[cfg(feature = "update")]
    pub fn is_very_low(&self) -> bool {
        self.compare_with(ENOUGH_FOR_CLOCK);
        // At least 5 us for the comparator.
        cortex_m::asm::delay(crate::chip::SYSCLK_HZ / 200_000);
        let is_low = self.is_low();
        self.compare_with(ENOUGH_FOR_WORDS);
        is_low
    }
}
