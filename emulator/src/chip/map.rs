//! The address map: the properties of an access and the block that each address belongs to.

use super::{
    rcc::{Apb, Gate},
    timer, usart,
};
use crate::Time;

/// First address of the flash.
pub const FLASH_BASE: u32 = 0x0800_0000;
/// First address of the SRAM.
pub const RAM_BASE: u32 = 0x2000_0000;
/// First address of the core-coupled memory.
pub const CCM_BASE: u32 = 0x1000_0000;

/// The bus responds with an error, and the CPU takes a BusFault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BusFault;

/// The width of an access.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Width {
    /// 8 bits.
    Byte,
    /// 16 bits.
    Half,
    /// 32 bits.
    Word,
}

impl Width {
    /// The number of bytes.
    pub const fn bytes(self) -> u32 {
        match self {
            Self::Byte => 1,
            Self::Half => 2,
            Self::Word => 4,
        }
    }

    pub(super) const fn mask(self) -> u32 {
        match self {
            Self::Byte => 0xFF,
            Self::Half => 0xFFFF,
            Self::Word => 0xFFFF_FFFF,
        }
    }
}

/// A load or store by the CPU, naturally aligned.
#[derive(Clone, Copy, Debug)]
pub struct Access {
    /// The address of the first byte.
    pub address: u32,
    /// The width.
    pub width: Width,
    /// The time of the access.
    pub now: Time,
    /// The address of the instruction.
    pub pc: u32,
}

/// The block that an address belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Block {
    Flash,
    FlashRegisters,
    Rcc,
    Pwr,
    /// TIM1 as 0.
    Timer(u8),
    /// USART1 as 0.
    Usart(u8),
    Rtc,
    Rng,
    Iwdg,
    /// CAN1 as 0.
    Can(u8),
    /// ADC1 and the common registers.
    Adc,
    Syscfg,
    Exti,
    Gpio(u8),
    Dbgmcu,
    Factory,
    Unknown,
}

impl Block {
    pub fn of(address: u32) -> (Self, u32) {
        let block = match address {
            0x4000_2800..0x4000_2C00 => Self::Rtc,
            0x4000_3000..0x4000_3400 => Self::Iwdg,
            0x4000_6400..0x4000_7000 => Self::Can((address >> 10 & 3) as u8 - 1),
            0x4000_7000..0x4000_7400 => Self::Pwr,
            0x4001_2000..0x4001_2400 => Self::Adc,
            0x4001_3800..0x4001_3C00 => Self::Syscfg,
            0x4001_3C00..0x4001_4000 => Self::Exti,
            0x4002_0000..0x4002_2C00 => Self::Gpio((address >> 10 & 0xF) as u8),
            0x4002_3800..0x4002_3C00 => Self::Rcc,
            0x4002_3C00..0x4002_4000 => Self::FlashRegisters,
            0xE004_2000..0xE004_2400 => Self::Dbgmcu,
            0x1FFF_0000..0x2000_0000 => Self::Factory,
            0x5006_0800..0x5006_0C00 => Self::Rng,
            FLASH_BASE..CCM_BASE => return (Self::Flash, address - FLASH_BASE),
            0x4000_0000..0x4001_0000 => Self::one_of_many(Apb::One, address),
            0x4001_0000..0x4002_0000 => Self::one_of_many(Apb::Two, address),
            _ => Self::Unknown,
        };
        (block, address & 0x3FF)
    }

    /// A timer or USART.
    fn one_of_many(apb: Apb, address: u32) -> Self {
        let place = (apb, address >> 10 & 0x3F);
        let timer = timer::KINDS.iter().position(|kind| (kind.gate.0, kind.slot) == place);
        let usart = usart::KINDS.iter().position(|kind| (kind.gate.0, kind.slot) == place);
        match (timer, usart) {
            (Some(number), _) => Self::Timer(number as u8),
            (_, Some(number)) => Self::Usart(number as u8),
            _ => Self::Unknown,
        }
    }

    pub fn gate(self) -> Option<Gate> {
        match self {
            Self::Timer(timer) => Some(Gate::Timer(timer)),
            Self::Usart(usart) => Some(Gate::Usart(usart)),
            Self::Rng => Some(Gate::Rng),
            Self::Pwr => Some(Gate::Pwr),
            Self::Can(can) => Some(Gate::Can(can)),
            Self::Adc => Some(Gate::Adc),
            Self::Syscfg => Some(Gate::Syscfg),
            Self::Gpio(port) => Some(Gate::Gpio(port)),
            _ => None,
        }
    }

    /// Whether the block is on an APB, whose bridge repeats a narrow write in every lane (RM0090 2.1.11).
    pub const fn on_apb(self) -> bool {
        matches!(
            self,
            Self::Timer(_)
                | Self::Usart(_)
                | Self::Rtc
                | Self::Iwdg
                | Self::Can(_)
                | Self::Adc
                | Self::Pwr
                | Self::Syscfg
                | Self::Exti
        )
    }
}
