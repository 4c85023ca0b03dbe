//! The chip's supply, as measured by the programmable voltage detector (RM0090, 5.2.3).

use stm32f4xx_hal::{pac::PWR, rcc::Enable};

use crate::start;

/// PLS for a rising supply of 2.70 to 2.82 V, depending on the chip (data sheet, VPVD4).
const ENOUGH_TO_START: u8 = 0b100;
/// PLS for a falling supply of 2.75 to 2.92 V, a rising one of 2.86 to 2.99 V (VPVD5).
const ENOUGH_FOR_WORDS: u8 = 0b101;

/// The voltage detector.
pub struct Supply {
    detector: PWR,
}

impl Supply {
    /// Switches the detector on, and waits up to 100 ms for the 2.7 V that the wait states of the clock need.
    pub fn wait(detector: PWR) -> Self {
        // SAFETY: the enable bit of PWR in RCC belongs to its owner; no interrupt changes others yet.
        unsafe { PWR::enable_unchecked() };
        let supply = Self { detector };
        supply.compare_with(ENOUGH_TO_START);
        if !start::comes_in_100_ms(|| !supply.is_low()) {
            defmt::warn!("the supply is below 2.7 V, which the clock needs");
        }
        supply.compare_with(ENOUGH_FOR_WORDS);
        supply
    }

    fn compare_with(&self, level: u8) {
        self.detector.cr().modify(|_, w| w.pls().set(level).pvde().set_bit());
    }

    /// Whether the supply may be below the 2.7 V for programming the flash in words.
    pub fn is_low(&self) -> bool {
        self.detector.csr().read().pvdo().bit_is_set()
    }
}

/// The same for those who have no handle of the detector, which is on.
#[cfg(feature = "update")]
pub fn is_low() -> bool {
    // SAFETY: reading the state has no effect.
    unsafe { &*PWR::ptr() }.csr().read().pvdo().bit_is_set()
}
