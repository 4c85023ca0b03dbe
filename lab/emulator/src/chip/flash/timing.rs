//! The program and erase times of the flash (STM32F405 data sheet, flash memory programming).

use crate::Time;

/// The column of the data sheet that applies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Timing {
    /// The typical times: 16 us per word; 250, 300 or 400 ms per 16 KB sector at x32, x16 or x8.
    #[default]
    Typical,
    /// The guaranteed times: 100 us per word; 500, 600 or 800 ms per 16 KB sector.
    Worst,
}

impl Timing {
    /// The time of a program operation of any width.
    pub const fn program(self) -> Time {
        match self {
            Self::Typical => Time::from_us(16),
            Self::Worst => Time::from_us(100),
        }
    }

    /// The time to program a double word of an STM32G4 (STM32G431 data sheet, flash memory characteristics).
    pub const fn program_double_word(self) -> Time {
        match self {
            Self::Typical => Time::from_ns(81_700),
            Self::Worst => Time::from_ns(83_400),
        }
    }

    /// The time to erase a page of 2 KB of an STM32G4.
    pub const fn erase_page(self) -> Time {
        match self {
            Self::Typical => Time::from_us(22_000),
            Self::Worst => Time::from_us(24_500),
        }
    }

    /// The erase time of a sector, by its number in its bank and PSIZE (0 = x8, 1 = x16, 2 = x32).
    pub const fn erase(self, sector: u32, psize: u32) -> Time {
        let typical = match (sector, psize) {
            (0..4, 0) => 400,
            (0..4, 1) => 300,
            (0..4, _) => 250,
            (4, 0) => 1200,
            (4, 1) => 700,
            (4, _) => 550,
            (_, 0) => 2000,
            (_, 1) => 1300,
            (_, _) => 1000,
        };
        match self {
            Self::Typical => Time::from_ms(typical),
            Self::Worst => Time::from_ms(2 * typical),
        }
    }
}
