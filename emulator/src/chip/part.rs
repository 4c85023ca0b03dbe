//! The STM32F4 parts that can be put on a board, and their differences.

use std::{error, fmt, str::FromStr};

/// A microcontroller, in the package with the largest memory that the firmware's `memory.x` relies on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Part {
    /// STM32F405xG: 168 MHz, 1 MB flash, 128 KB + 64 KB RAM.
    Stm32f405,
    /// STM32F407xG: as the F405, with Ethernet and camera interface.
    Stm32f407,
    /// STM32F427xI: 180 MHz, 2 MB flash in two banks, 192 KB + 64 KB RAM.
    Stm32f427,
    /// STM32F446xE: 180 MHz, 512 KB flash, 128 KB RAM.
    Stm32f446,
}

/// There is no chip of this name.
#[derive(Debug)]
pub struct UnknownPart;

impl fmt::Display for UnknownPart {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the chips are {}", Part::ALL.map(Part::name).join(", "))
    }
}

impl error::Error for UnknownPart {}

impl FromStr for Part {
    type Err = UnknownPart;

    fn from_str(name: &str) -> Result<Self, UnknownPart> {
        Self::ALL.into_iter().find(|part| part.name() == name).ok_or(UnknownPart)
    }
}

const KB: u32 = 1024;

impl Part {
    /// Every part, in the order of their numbers.
    pub const ALL: [Self; 4] = [Self::Stm32f405, Self::Stm32f407, Self::Stm32f427, Self::Stm32f446];

    /// The name in lower case, which is also the firmware's feature: `stm32f405`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Stm32f405 => "stm32f405",
            Self::Stm32f407 => "stm32f407",
            Self::Stm32f427 => "stm32f427",
            Self::Stm32f446 => "stm32f446",
        }
    }

    /// Bytes of flash at 0x0800_0000.
    pub const fn flash_size(self) -> u32 {
        match self {
            Self::Stm32f405 | Self::Stm32f407 => 1024 * KB,
            Self::Stm32f427 => 2048 * KB,
            Self::Stm32f446 => 512 * KB,
        }
    }

    /// Bytes of flash per bank: the CPU stalls only when it needs the busy bank.
    pub const fn flash_bank_size(self) -> u32 {
        match self {
            Self::Stm32f427 => 1024 * KB,
            _ => self.flash_size(),
        }
    }

    /// Bytes of SRAM at 0x2000_0000 (SRAM1, SRAM2 and SRAM3 adjoin).
    pub const fn ram_size(self) -> u32 {
        match self {
            Self::Stm32f405 | Self::Stm32f407 | Self::Stm32f446 => 128 * KB,
            Self::Stm32f427 => 192 * KB,
        }
    }

    /// Bytes of core-coupled memory at 0x1000_0000, or 0: data only, no code.
    pub const fn ccm_size(self) -> u32 {
        match self {
            Self::Stm32f405 | Self::Stm32f407 | Self::Stm32f427 => 64 * KB,
            Self::Stm32f446 => 0,
        }
    }

    /// DBGMCU_IDCODE (RM0090 38.6.1, RM0390 33.6.1): device in bits 11..0, revision in bits 31..16.
    pub const fn id_code(self) -> u32 {
        match self {
            Self::Stm32f405 | Self::Stm32f407 => 0x100F_0413,
            Self::Stm32f427 => 0x2003_0419,
            Self::Stm32f446 => 0x1000_0421,
        }
    }

    /// The number of interrupt lines of the NVIC.
    pub const fn irq_count(self) -> u16 {
        match self {
            Self::Stm32f405 | Self::Stm32f407 => 82,
            Self::Stm32f427 => 91,
            Self::Stm32f446 => 97,
        }
    }

    /// The highest legal (SYSCLK, APB1, APB2) in Hz, with over-drive if the part has it.
    pub const fn clock_limits(self) -> (u32, u32, u32) {
        match self {
            Self::Stm32f405 | Self::Stm32f407 => (168_000_000, 42_000_000, 84_000_000),
            Self::Stm32f427 | Self::Stm32f446 => (180_000_000, 45_000_000, 90_000_000),
        }
    }

    /// Whether the PWR block has over-drive and the SAI PLL exists.
    pub const fn has_overdrive(self) -> bool {
        matches!(self, Self::Stm32f427 | Self::Stm32f446)
    }

    /// The number of GPIO ports, from A on.
    pub const fn gpio_ports(self) -> usize {
        match self {
            Self::Stm32f405 | Self::Stm32f407 => 9,
            Self::Stm32f427 => 11,
            Self::Stm32f446 => 8,
        }
    }
}
