//! The chip's supply, as measured by the programmable voltage detector (RM0090, 5.2.3).

use stm32f4xx_hal::{pac::PWR, rcc::Enable};

/// PLS for 2.7 V: required by five wait states at 160 MHz and by programming the flash in words.
const LEVEL: u8 = 0b101;

/// The voltage detector.
pub struct Supply {
    detector: PWR,
}

impl Supply {
    /// Switches the detector on.
    pub fn watch(detector: PWR) -> Self {
        // SAFETY: the enable bit of PWR in RCC belongs to its owner; no interrupt changes others yet.
        unsafe { PWR::enable_unchecked() };
        detector.cr().modify(|_, w| w.pls().set(LEVEL).pvde().set_bit());
        Self { detector }
    }

    /// Whether the supply is below 2.7 V, or was until a moment ago.
    pub fn is_low(&self) -> bool {
        self.detector.csr().read().pvdo().bit_is_set()
    }
}
