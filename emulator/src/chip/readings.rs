//! What manuals and reports leave open about the chip, as switches: a program must work under each of them.

use super::Timing;
use crate::Time;

/// How one chip may differ from another; the default is the nominal chip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Readings {
    /// The 16 KB below the SRAM answer: loads read 0, stores are lost. Otherwise they are bus faults.
    pub no_fault_below_ram: bool,
    /// How many times its cycles an instruction takes, for flash wait states and cache misses: 1 to 3.
    pub slowdown: u8,
    /// A word whose programming was cut off reads as anything between its old and its new value, otherwise at each
    /// power-on, until it is programmed again or erased.
    pub cut_words_flip: bool,
    /// The frequency of LSI in Hz: 17,000 to 47,000 (F405 data sheet, table 35).
    pub lsi_hz: u32,
    /// From HSEON to HSERDY: 0.1 to 10 ms with a crystal that works; [`Time::MAX`]: never.
    pub hse_start: Time,
    /// How long the flash takes to program and to erase.
    pub flash_timing: Timing,
}

impl Default for Readings {
    fn default() -> Self {
        Self {
            no_fault_below_ram: false,
            slowdown: 1,
            cut_words_flip: false,
            lsi_hz: 32_000,
            hse_start: Time::from_ms(2),
            flash_timing: Timing::Typical,
        }
    }
}
