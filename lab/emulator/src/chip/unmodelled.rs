//! Peripherals that are not modelled: their registers keep what is written, and their accesses have names.

use std::collections::BTreeMap;

use super::{Block, Chip, Finding, Problem, part::Family};

/// The bits that a program has written, and that no model has taken, by block and address of the word.
#[derive(Debug, Default)]
pub(super) struct Kept(BTreeMap<(Block, u32), u32>);

impl Kept {
    pub fn bits(&self, block: Block, address: u32) -> u32 {
        self.0.get(&(block, address)).copied().unwrap_or(0)
    }

    pub fn set(&mut self, block: Block, address: u32, bits: u32) {
        match bits {
            0 => self.0.remove(&(block, address)),
            _ => self.0.insert((block, address), bits),
        };
    }

    pub fn reset(&mut self, block: Block) {
        self.0.retain(|(of, _), _| *of != block);
    }
}

impl Block {
    /// Whether the board works only with all of its registers.
    pub(super) fn is_strict(self) -> bool {
        use Block::{Can, Flash, FlashRegisters, Gpio, Pwr, Rcc};
        matches!(self, Can(_) | Flash | FlashRegisters | Gpio(_) | Pwr | Rcc)
    }
}

impl Chip {
    /// Whether a finding is only an access to a peripheral that is not modelled: other than CAN, RCC, flash, power and
    /// GPIO. Such a register reads as it was written.
    pub fn is_tolerable(&self, finding: &Finding) -> bool {
        let (block, _) = Block::of(self.part.family(), finding.address);
        finding.problem == Problem::Unmodelled && !block.is_strict()
    }

    /// The name of a register: its peripheral and its offset there, or the address.
    pub fn register_name(&self, address: u32) -> String {
        let (start, name) = match (self.part.family(), address) {
            (Family::F4, 0x4000_0000..0x4000_8000) => (address & !0x3FF, APB1[place(address)]),
            (Family::F4, 0x4001_0000..0x4001_8000) => (address & !0x3FF, APB2[place(address)]),
            (Family::F4, _) => {
                let begins = AHB.iter().rev().find(|(start, _)| *start <= address);
                begins.copied().unwrap_or((address, ""))
            }
            (Family::G4, _) => (address, ""),
        };
        if name.is_empty() {
            return format!("{address:08X}h");
        }
        format!("{name}, offset {:02X}h", (address & !3) - start)
    }
}

/// The kilobyte of an address on its peripheral bus.
const fn place(address: u32) -> usize {
    (address >> 10 & 0x1F) as usize
}

/// The peripherals of each kilobyte of APB1 and APB2, and those of the AHB by their first addresses (RM0090 table 1,
/// RM0390 table 1, RM0430 table 1).
const APB1: [&str; 32] = [
    "TIM2", "TIM3", "TIM4", "TIM5", "TIM6", "TIM7", "TIM12", "TIM13", "TIM14", "LPTIM1", "RTC",
    "WWDG", "IWDG", "I2S2ext", "SPI2", "SPI3", "I2S3ext", "USART2", "USART3", "UART4", "UART5",
    "I2C1", "I2C2", "I2C3", "FMPI2C1", "CAN1", "CAN2", "CAN3/CEC", "PWR", "DAC", "UART7", "UART8",
];
const APB2: [&str; 32] = [
    "TIM1", "TIM8", "", "", "USART1", "USART6", "UART9", "UART10", "ADC", "", "", "SDIO", "SPI1",
    "SPI4", "SYSCFG", "EXTI", "TIM9", "TIM10", "TIM11", "", "SPI5", "SPI6", "SAI1", "SAI2",
    "DFSDM1", "", "LTDC/DSI", "LTDC/DSI", "", "", "", "",
];
const AHB: [(u32, &str); 18] = [
    (0x4002_0000, "GPIO"),
    (0x4002_3000, "CRC"),
    (0x4002_3400, ""),
    (0x4002_3800, "RCC"),
    (0x4002_3C00, "FLASH"),
    (0x4002_6000, "DMA1"),
    (0x4002_6400, "DMA2"),
    (0x4002_8000, "ETH"),
    (0x4002_9400, ""),
    (0x4002_B000, "DMA2D"),
    (0x4002_BC00, ""),
    (0x4004_0000, "OTG_HS"),
    (0x5000_0000, "OTG_FS"),
    (0x5005_0000, "DCMI"),
    (0x5006_0000, "CRYP, HASH or RNG"),
    (0xA000_0000, "FMC or QUADSPI"),
    (0xA000_2000, ""),
    (0xE004_2000, "DBGMCU"),
];
