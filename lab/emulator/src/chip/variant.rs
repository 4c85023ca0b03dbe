//! The variants of the chip that manuals and reports leave open: a program must work on each of them.

use super::{Thresholds, Timing};
use crate::Time;

/// Differences from the nominal chip, which is the default.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ChipVariant {
    /// The 16 KB below the SRAM respond: loads read 0, stores are lost. Otherwise an access is a bus fault.
    pub no_fault_below_ram: bool,
    /// The factor for the cycles of an instruction, for flash wait states and cache misses: 1 to 3.
    pub slowdown: u8,
    /// A read of the flash takes the wait states of FLASH_ACR unless the prefetch or a cache hides them (RM0090 3.5).
    /// Otherwise, and on an STM32G4, it takes none.
    pub flash_waits: bool,
    /// The code that waits for the flash is in the instruction cache, so that the core runs on while the flash is busy.
    /// Otherwise the core stalls at its next fetch from the busy bank.
    pub cached_code: bool,
    /// A word whose programming was interrupted reads as any value between the old and the new one, differently at each
    /// power-on, until it is programmed again or erased.
    pub cut_words_flip: bool,
    /// The frequency of LSI in Hz: 17,000 to 47,000 (F405 data sheet, table 35).
    pub lsi_hz: u32,
    /// From HSEON to HSERDY: 0.1 to 10 ms for a working crystal; [`Time::MAX`] for one that never starts.
    pub hse_start: Time,
    /// HSE is an external clock, which starts only with HSEBYP; a crystal starts only without.
    pub external_clock: bool,
    /// The error of HSI in millionths: -80,000 to 45,000 over the range of temperatures (F405 data sheet, table 34).
    pub hsi_ppm: i32,
    pub start_up: StartUp,
    /// After each reset a boot loader starts the program, and leaves the chip as the one in ROM does after
    /// `dfu-util ... :leave`: see [`Chip::leave_loader`](super::Chip::leave_loader).
    pub boot_loader: bool,
    /// The RAM has random content after the first power-on only: it remembers over the others, as over a short cut.
    pub ram_remembers: bool,
    /// The core cycles until the falling level of an interrupt line reaches the core: an interrupt that is acknowledged late
    /// comes again. 12 are usual, some hundred possible behind a slow bus.
    pub late_lines: u16,
    pub thresholds: Thresholds,
    pub flash_timing: Timing,
}

/// The start-up times of the reset circuit, the PLL and LSI, within their range in the F405 data sheet.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum StartUp {
    /// The shortest times: 0.5 ms, 75 us and 15 us.
    Fastest,
    /// The typical times: 1.5 ms, 100 us and 20 us.
    #[default]
    Typical,
    /// The longest times: 3 ms, 300 us and 40 us.
    Slowest,
}

impl StartUp {
    /// The times of the reset circuit, the PLL and LSI in microseconds.
    const fn us(self) -> [u64; 3] {
        match self {
            Self::Fastest => [500, 75, 15],
            Self::Typical => [1_500, 100, 20],
            Self::Slowest => [3_000, 300, 40],
        }
    }

    /// The time for which NRST stays low after the supply has come up (tRSTTEMPO).
    pub const fn reset(self) -> Time {
        Time::from_us(self.us()[0])
    }

    pub(super) const fn pll(self) -> Time {
        Time::from_us(self.us()[1])
    }

    pub(super) const fn lsi(self) -> Time {
        Time::from_us(self.us()[2])
    }
}

impl Default for ChipVariant {
    fn default() -> Self {
        Self {
            no_fault_below_ram: false,
            slowdown: 1,
            flash_waits: false,
            cached_code: false,
            cut_words_flip: false,
            lsi_hz: 32_000,
            hse_start: Time::from_ms(2),
            external_clock: false,
            hsi_ppm: 0,
            start_up: StartUp::Typical,
            boot_loader: false,
            ram_remembers: false,
            late_lines: 0,
            thresholds: Thresholds::Typical,
            flash_timing: Timing::Typical,
        }
    }
}
