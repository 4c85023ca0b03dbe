//! The address map: the block that each address belongs to, and its gate in RCC.

use super::{
    g4,
    part::Family,
    rcc::{self, Gate},
    registers::{Apb, Place},
    spi, timer,
};
use crate::can::fdcan;

pub const FLASH_BASE: u32 = 0x0800_0000;
pub const RAM_BASE: u32 = 0x2000_0000;
/// First address of the core-coupled memory.
pub const CCM_BASE: u32 = 0x1000_0000;

/// The block that an address belongs to. Those of one kind are counted from 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Block {
    Flash,
    FlashRegisters,
    Rcc,
    Pwr,
    Timer(usize),
    Spi(usize),
    Crc,
    Iwdg,
    Can(usize),
    /// ADC1 and the common registers.
    Adc,
    Syscfg,
    Exti,
    Gpio(usize),
    Dbgmcu,
    Factory,
    Unknown,
}

impl Block {
    pub fn of(family: Family, address: u32) -> (Self, u32) {
        match family {
            Family::F4 => Self::of_f4(address),
            Family::G4 => Self::of_g4(address),
        }
    }

    fn of_f4(address: u32) -> (Self, u32) {
        let block = match address {
            0x4000_0000..0x4001_0000 => Self::at((Apb::One, address >> 10 & 0x3F)),
            0x4001_0000..0x4002_0000 => Self::at((Apb::Two, address >> 10 & 0x3F)),
            0x4002_0000..0x4002_2C00 => Self::Gpio((address >> 10 & 0xF) as usize),
            0x4002_3000..0x4002_3400 => Self::Crc,
            0x4002_3800..0x4002_3C00 => Self::Rcc,
            0x4002_3C00..0x4002_4000 => Self::FlashRegisters,
            0xE004_2000..0xE004_2400 => Self::Dbgmcu,
            0x1FFF_0000..0x2000_0000 => Self::Factory,
            FLASH_BASE..CCM_BASE => return (Self::Flash, address - FLASH_BASE),
            _ => Self::Unknown,
        };
        (block, address & 0x3FF)
    }

    /// The blocks of an STM32G4 that are modelled (RM0440 2.2.2). The message RAM follows the registers of FDCAN1.
    fn of_g4(address: u32) -> (Self, u32) {
        let block = match address {
            0x4000_0000..0x4000_0C00 | 0x4000_1000..0x4000_1800 | 0x4000_7000..0x4000_7400 => {
                Self::at((Apb::One, address >> 10 & 0x3F))
            }
            // TIM15 to TIM17 count as TIM9 to TIM11 do, and have their places and interrupts.
            0x4001_4000..0x4001_4C00 => Self::at((Apb::Two, address >> 10 & 0x3F)),
            0x4000_3000..0x4000_3400 => Self::Iwdg,
            0x4000_6400..0x4000_6800 => Self::Can(0),
            0x4000_A400..0x4000_A800 => return (Self::Can(0), fdcan::RAM + (address & 0x3FF)),
            0x4001_0000..0x4001_0400 => Self::Syscfg,
            0x4001_0400..0x4001_0800 => Self::Exti,
            0x4002_1000..0x4002_1400 => Self::Rcc,
            0x4002_2000..0x4002_2400 => Self::FlashRegisters,
            0x4800_0000..0x4800_1C00 => Self::Gpio((address >> 10 & 0xF) as usize),
            0xE004_2000..0xE004_2400 => Self::Dbgmcu,
            0x1FFF_0000..0x2000_0000 => Self::Factory,
            FLASH_BASE..CCM_BASE => return (Self::Flash, address - FLASH_BASE),
            _ => Self::Unknown,
        };
        (block, address & 0x3FF)
    }

    fn at(place: Place) -> Self {
        match place {
            (Apb::One, 12) => Self::Iwdg,
            (Apb::One, 25..28) => Self::Can(place.1 as usize - 25),
            (Apb::One, 28) => Self::Pwr,
            (Apb::Two, 8) => Self::Adc,
            (Apb::Two, 14) => Self::Syscfg,
            (Apb::Two, 15) => Self::Exti,
            _ => {
                let timer = timer::KINDS.iter().position(|kind| kind.place == place);
                let spi = spi::KINDS.iter().position(|kind| kind.place == place);
                timer.map(Self::Timer).or(spi.map(Self::Spi)).unwrap_or(Self::Unknown)
            }
        }
    }

    /// The block's gate, if it has one. The reset of ADC1 is that of all ADCs.
    pub fn gate(self, family: Family) -> Option<Gate> {
        let is_g4 = family == Family::G4;
        let (bus, bit) = match self {
            Self::Gpio(port) if is_g4 => return Some((g4::AHB2ENR, port as u32)),
            Self::Gpio(port) => return Some((rcc::AHB1ENR, port as u32)),
            Self::Adc | Self::Spi(_) if is_g4 => return None,
            Self::Syscfg if is_g4 => (Apb::Two, 0),
            Self::Crc => return Some((rcc::AHB1ENR, 12)),
            Self::Timer(timer) => timer::KINDS[timer].place,
            Self::Spi(spi) => spi::KINDS[spi].place,
            Self::Can(can) => (Apb::One, 25 + can as u32),
            Self::Pwr => (Apb::One, 28),
            Self::Adc => (Apb::Two, 8),
            Self::Syscfg => (Apb::Two, 14),
            _ => return None,
        };
        let register = match (bus, is_g4) {
            (Apb::One, false) => rcc::APB1ENR,
            (Apb::Two, false) => rcc::APB2ENR,
            (Apb::One, true) => g4::APB1ENR1,
            (Apb::Two, true) => g4::APB2ENR,
        };
        Some((register, bit))
    }
}

/// Whether the address is on an APB, whose bridge repeats a narrow write in every lane (RM0090 2.1.11).
pub(super) const fn is_on_apb(address: u32) -> bool {
    address >> 17 == 0x4000_0000 >> 17
}
