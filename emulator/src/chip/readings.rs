//! Switches for the properties that manuals and reports leave open. A program must work under each of them.

use super::Timing;
use crate::Time;

/// The variations between chips; the default is the nominal chip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Readings {
    /// The 16 KB below the SRAM respond: loads read 0, stores are lost. Otherwise an access is a bus fault.
    pub no_fault_below_ram: bool,
    /// The factor for the cycles of an instruction, for flash wait states and cache misses: 1 to 3.
    pub slowdown: u8,
    /// A read of the flash takes the wait states of FLASH_ACR unless the prefetch or a cache hides them (RM0090 3.5).
    /// Otherwise it takes none.
    pub flash_waits: bool,
    /// A word whose programming was interrupted reads as any value between the old and the new one, differently at each
    /// power-on, until it is programmed again or erased.
    pub cut_words_flip: bool,
    /// The frequency of LSI in Hz: 17,000 to 47,000 (F405 data sheet, table 35).
    pub lsi_hz: u32,
    /// From HSEON to HSERDY: 0.1 to 10 ms for a working crystal; [`Time::MAX`] for one that never starts.
    pub hse_start: Time,
    /// The programming and erase times of the flash.
    pub flash_timing: Timing,
}

impl Default for Readings {
    fn default() -> Self {
        Self {
            no_fault_below_ram: false,
            slowdown: 1,
            flash_waits: false,
            cut_words_flip: false,
            lsi_hz: 32_000,
            hse_start: Time::from_ms(2),
            flash_timing: Timing::Typical,
        }
    }
}
