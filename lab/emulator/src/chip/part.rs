//! The parts that can be put on a board, and their differences: those of the STM32F4, and one STM32G4.

use std::{error, fmt, str::FromStr};

use super::Pin;

/// A microcontroller, in its version with the largest flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Part {
    /// STM32F405xG: 168 MHz, 1 MB flash, 128 KB + 64 KB RAM.
    Stm32f405,
    /// STM32F407xG: as the F405, with Ethernet and camera interface.
    Stm32f407,
    /// STM32F412xG: 100 MHz, 1 MB flash, 256 KB RAM.
    Stm32f412,
    /// STM32F413xH: 100 MHz, 1.5 MB flash, 320 KB RAM, a third CAN controller.
    Stm32f413,
    /// STM32F415xG: as the F405, with cryptographic processor.
    Stm32f415,
    /// STM32F417xG: as the F407, with cryptographic processor.
    Stm32f417,
    /// STM32F423xH: as the F413, with AES.
    Stm32f423,
    /// STM32F427xI: 180 MHz, 2 MB flash in two banks, 192 KB + 64 KB RAM.
    Stm32f427,
    /// STM32F429xI: as the F427, with display controller.
    Stm32f429,
    /// STM32F437xI: as the F427, with cryptographic processor.
    Stm32f437,
    /// STM32F439xI: as the F429, with cryptographic processor.
    Stm32f439,
    /// STM32F446xE: 180 MHz, 512 KB flash, 128 KB RAM.
    Stm32f446,
    /// STM32F469xI: 180 MHz, 2 MB flash in two banks, 320 KB + 64 KB RAM.
    Stm32f469,
    /// STM32F479xI: as the F469, with cryptographic processor.
    Stm32f479,
    /// STM32G431xB: 170 MHz, 128 KB flash, 32 KB RAM, FDCAN.
    Stm32g431,
}

/// Parts with the same registers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Family {
    F4,
    G4,
}

#[derive(Debug)]
pub struct UnknownPart;

impl fmt::Display for UnknownPart {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the chips are {}", Part::F4.map(Part::name).join(", "))
    }
}

impl error::Error for UnknownPart {}

/// Reads the name of an STM32F4; [`Part::any`] knows every part.
impl FromStr for Part {
    type Err = UnknownPart;

    fn from_str(name: &str) -> Result<Self, UnknownPart> {
        Self::F4.into_iter().find(|part| part.name() == name).ok_or(UnknownPart)
    }
}

const KB: u32 = 1024;
const MHZ: u32 = 1_000_000;

/// Parts that differ in nothing that is modelled, in the order of the tables below.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Line {
    /// F405, F407, F415, F417 (RM0090).
    F405,
    /// F412 (RM0402).
    F412,
    /// F413, F423 (RM0430).
    F413,
    /// F427, F429, F437, F439 (RM0090).
    F427,
    /// F446 (RM0390).
    F446,
    /// F469, F479 (RM0386).
    F469,
    /// G431 (RM0440).
    G431,
}

impl Part {
    /// Every STM32F4, in the order of their numbers.
    pub const F4: [Self; 14] = [
        Self::Stm32f405,
        Self::Stm32f407,
        Self::Stm32f412,
        Self::Stm32f413,
        Self::Stm32f415,
        Self::Stm32f417,
        Self::Stm32f423,
        Self::Stm32f427,
        Self::Stm32f429,
        Self::Stm32f437,
        Self::Stm32f439,
        Self::Stm32f446,
        Self::Stm32f469,
        Self::Stm32f479,
    ];

    /// The part of this name.
    ///
    /// # Errors
    /// There is none.
    pub fn any(name: &str) -> Result<Self, UnknownPart> {
        if name == Self::Stm32g431.name() { Ok(Self::Stm32g431) } else { name.parse() }
    }

    const fn line(self) -> Line {
        match self {
            Self::Stm32f405 | Self::Stm32f407 | Self::Stm32f415 | Self::Stm32f417 => Line::F405,
            Self::Stm32f412 => Line::F412,
            Self::Stm32f413 | Self::Stm32f423 => Line::F413,
            Self::Stm32f427 | Self::Stm32f429 | Self::Stm32f437 | Self::Stm32f439 => Line::F427,
            Self::Stm32f446 => Line::F446,
            Self::Stm32f469 | Self::Stm32f479 => Line::F469,
            Self::Stm32g431 => Line::G431,
        }
    }

    pub(super) const fn family(self) -> Family {
        match self.line() {
            Line::G431 => Family::G4,
            _ => Family::F4,
        }
    }

    /// The name in lower case, which is also the firmware's feature: `stm32f405`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Stm32f405 => "stm32f405",
            Self::Stm32f407 => "stm32f407",
            Self::Stm32f412 => "stm32f412",
            Self::Stm32f413 => "stm32f413",
            Self::Stm32f415 => "stm32f415",
            Self::Stm32f417 => "stm32f417",
            Self::Stm32f423 => "stm32f423",
            Self::Stm32f427 => "stm32f427",
            Self::Stm32f429 => "stm32f429",
            Self::Stm32f437 => "stm32f437",
            Self::Stm32f439 => "stm32f439",
            Self::Stm32f446 => "stm32f446",
            Self::Stm32f469 => "stm32f469",
            Self::Stm32f479 => "stm32f479",
            Self::Stm32g431 => "stm32g431",
        }
    }

    /// The number of the reference manual.
    pub const fn manual(self) -> &'static str {
        ["RM0090", "RM0402", "RM0430", "RM0090", "RM0390", "RM0386", "RM0440"][self.line() as usize]
    }

    /// Bytes of flash at 0x0800_0000.
    pub const fn flash_size(self) -> u32 {
        [1024, 1024, 1536, 2048, 512, 2048, 128][self.line() as usize] * KB
    }

    /// Bytes of flash per bank: the CPU stalls only when it needs the busy bank.
    pub const fn flash_bank_size(self) -> u32 {
        if self.has_two_banks() { self.flash_size() / 2 } else { self.flash_size() }
    }

    /// Whether the flash has two banks of twelve sectors.
    pub const fn has_two_banks(self) -> bool {
        matches!(self.line(), Line::F427 | Line::F469)
    }

    /// The bits of FLASH_OPTCR that protect sectors; on the F413 the last bit is for two sectors.
    pub(super) const fn protection_bits(self) -> u32 {
        match self.line() {
            Line::F413 => 0x7FFF_0000,
            _ => 0x0FFF_0000,
        }
    }

    /// Bytes of SRAM at 0x2000_0000 (SRAM1, SRAM2 and SRAM3 adjoin, and on the G431 the core-coupled memory).
    pub const fn ram_size(self) -> u32 {
        [128, 256, 320, 192, 128, 320, 32][self.line() as usize] * KB
    }

    /// Bytes of core-coupled memory at 0x1000_0000, or 0: data only, no code. That of the G431 is modelled only in the
    /// place where it adjoins the SRAM.
    pub const fn ccm_size(self) -> u32 {
        [64, 0, 0, 64, 0, 64, 0][self.line() as usize] * KB
    }

    /// DBGMCU_IDCODE (chapter "Debug support" of the manual): device in bits 11..0, revision in bits 31..16.
    pub const fn id_code(self) -> u32 {
        match self.line() {
            Line::F405 => 0x100F_0413,
            Line::F412 => 0x3000_0441,
            Line::F413 => 0x1000_0463,
            Line::F427 => 0x2003_0419,
            Line::F446 => 0x1000_0421,
            Line::F469 => 0x1000_0434,
            Line::G431 => 0x2001_0468,
        }
    }

    /// The highest legal (SYSCLK, APB1, APB2) in Hz, with over-drive if the part has it.
    pub const fn clock_limits(self) -> (u32, u32, u32) {
        match self.line() {
            Line::F405 => (168 * MHZ, 42 * MHZ, 84 * MHZ),
            Line::F412 | Line::F413 => (100 * MHZ, 50 * MHZ, 100 * MHZ),
            Line::F427 | Line::F446 | Line::F469 => (180 * MHZ, 45 * MHZ, 90 * MHZ),
            Line::G431 => (170 * MHZ, 170 * MHZ, 170 * MHZ),
        }
    }

    /// The highest HCLK in Hz at the value of PWR_CR.VOS, with over-drive or without (chapter "Power controller").
    pub(super) const fn voltage_limit(self, vos: u32, overdrive: bool) -> u32 {
        match (self.line(), vos, overdrive) {
            (Line::F405, 0b01, _) => 168 * MHZ,
            (Line::F405, _, _) => 144 * MHZ,
            (Line::F412 | Line::F413, 0b11, _) => 100 * MHZ,
            (Line::F412 | Line::F413, 0b10, _) => 84 * MHZ,
            (Line::F412 | Line::F413, _, _) => 64 * MHZ,
            (_, 0b11, true) => 180 * MHZ,
            (_, 0b11, false) | (_, 0b10, true) => 168 * MHZ,
            (_, 0b10, false) => 144 * MHZ,
            _ => 120 * MHZ,
        }
    }

    /// PWR_CR after a reset.
    pub(super) const fn power_after_reset(self) -> u32 {
        match self.line() {
            Line::F405 => 0x4000,
            Line::F412 | Line::F413 => 0x8000,
            _ => 0xC000,
        }
    }

    /// The bits of PWR_CR that can be written.
    pub(super) const fn power_bits(self) -> u32 {
        match self.line() {
            Line::F405 => 0x43F3,
            Line::F412 | Line::F413 => 0x0030_EFF3,
            _ => 0x000F_EFF3,
        }
    }

    /// The flash wait states that `hclk_hz` needs at a supply (chapter "Embedded flash memory interface"), on the G431
    /// at any, in range 1 with boost or without.
    ///
    /// Below 2.7 V the manual of the chips of 100 MHz was not available: the steps are those of a related one, or less.
    pub(super) const fn wait_states(self, hclk_hz: u32, is_boosted: bool, supply_mv: u32) -> u32 {
        let low_supply = match (self.line(), supply_mv) {
            (Line::G431, _) | (_, 2_700..) => None,
            (Line::F412 | Line::F413, 2_400..) => Some(20),
            (Line::F412 | Line::F413, 2_100..) => Some(18),
            (Line::F412 | Line::F413, _) => Some(16),
            (_, 2_400..) => Some(24),
            (_, 2_100..) => Some(22),
            _ => Some(20),
        };
        if let Some(mhz) = low_supply {
            return hclk_hz.saturating_sub(1) / (mhz * MHZ);
        }
        match self.line() {
            Line::G431 if is_boosted => hclk_hz.saturating_sub(1) / (34 * MHZ),
            Line::F412 if hclk_hz <= 30 * MHZ => 0,
            Line::F412 if hclk_hz <= 64 * MHZ => 1,
            Line::F412 if hclk_hz <= 90 * MHZ => 2,
            Line::F412 => 3,
            // ST's header for this part has the values of the F412, which are laxer.
            Line::F413 => hclk_hz.saturating_sub(1) / (25 * MHZ),
            _ => hclk_hz.saturating_sub(1) / (30 * MHZ),
        }
    }

    /// Whether the PWR block has over-drive and the SAI PLL exists.
    pub const fn has_overdrive(self) -> bool {
        matches!(self.line(), Line::F427 | Line::F446 | Line::F469)
    }

    /// Whether RCC_DCKCFGR exists.
    pub(super) const fn has_dedicated_clocks(self) -> bool {
        !matches!(self.line(), Line::F405)
    }

    /// Whether RCC_CKGATENR and RCC_DCKCFGR2 exist.
    pub(super) const fn has_clock_gating(self) -> bool {
        matches!(self.line(), Line::F412 | Line::F413 | Line::F446)
    }

    /// The ADC channel of the temperature sensor: on the later parts it shares that of VBAT (RM0090 13.10, RM0390
    /// 13.10).
    pub(super) const fn temperature_channel(self) -> u32 {
        match self.line() {
            Line::F405 => 16,
            _ => 18,
        }
    }

    /// The number of GPIO ports, from A on.
    pub const fn gpio_ports(self) -> usize {
        [9, 8, 8, 11, 8, 11, 7][self.line() as usize]
    }

    /// The number of CAN controllers.
    pub const fn cans(self) -> usize {
        [2, 2, 3, 2, 2, 2, 1][self.line() as usize]
    }

    /// The pins that can carry a CAN controller (CAN1 as 0), receive and transmit, with their alternate functions. Each
    /// receive pin goes with each transmit pin (data sheet, table of the alternate functions).
    pub const fn can_pins(self, can: usize) -> &'static [[(Pin, u32); 2]] {
        const fn pair(receive: Pin, transmit: Pin, function: u32) -> [(Pin, u32); 2] {
            [(receive, function), (transmit, function)]
        }
        const A: [(Pin, u32); 2] = pair(Pin('A', 11), Pin('A', 12), 9);
        const B: [(Pin, u32); 2] = pair(Pin('B', 8), Pin('B', 9), 9);
        const B_8: [(Pin, u32); 2] = pair(Pin('B', 8), Pin('B', 9), 8);
        const D: [(Pin, u32); 2] = pair(Pin('D', 0), Pin('D', 1), 9);
        const G: [(Pin, u32); 2] = pair(Pin('G', 0), Pin('G', 1), 9);
        const I: [(Pin, u32); 2] = pair(Pin('I', 9), Pin('H', 13), 9);
        const B_LOW: [(Pin, u32); 2] = pair(Pin('B', 5), Pin('B', 6), 9);
        const B_HIGH: [(Pin, u32); 2] = pair(Pin('B', 12), Pin('B', 13), 9);
        const G_HIGH: [(Pin, u32); 2] = pair(Pin('G', 11), Pin('G', 12), 9);
        const A_11: [(Pin, u32); 2] = pair(Pin('A', 8), Pin('A', 15), 11);
        const B_11: [(Pin, u32); 2] = pair(Pin('B', 3), Pin('B', 4), 11);
        match (can, self.line()) {
            (0, Line::F405 | Line::F427 | Line::F469) => &[A, B, D, I],
            (0, Line::F412 | Line::F413) => &[A, B_8, D, G],
            (0, Line::F446 | Line::G431) => &[A, B, D],
            (1, Line::F412 | Line::F413) => &[B_LOW, B_HIGH, G_HIGH],
            (1, _) => &[B_LOW, B_HIGH],
            (2, Line::F413) => &[A_11, B_11],
            _ => &[],
        }
    }
}
