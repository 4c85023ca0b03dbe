//! The option bytes, as a programming tool has left them (RM0090 3.7). A program reads them in OPTCR and OPTCR1.

use crate::chip::Part;

const OPTLOCK: u32 = 1 << 0;
const BOR_LEV: u32 = 0b11 << 2;
const NSWBOOT0: u32 = 1 << 26;
const NBOOT0: u32 = 1 << 27;

#[derive(Debug)]
pub struct Options {
    part: Part,
    /// OPTCR, and OPTCR1 of parts with two banks, which protects the other sectors.
    registers: [u32; 2],
    /// FLASH_OPTR of an STM32G4 (RM0440 3.7.8).
    optr: u32,
}

impl Options {
    /// The factory settings: no protection, the lowest brown-out level.
    pub fn new(part: Part) -> Self {
        let bits = part.protection_bits();
        let second = if part.has_two_banks() { bits } else { 0 };
        Self { part, registers: [bits | 0xAAEC | OPTLOCK, second], optr: 0xFFEF_F8AA }
    }

    /// Protects the sectors whose bit is 1, and no others.
    pub fn protect(&mut self, sectors: u32) {
        for sector in 0..28 {
            let (register, bit) = self.protection(sector);
            self.registers[register] |= bit;
        }
        for sector in (0..28).filter(|sector| sectors >> sector & 1 == 1) {
            let (register, bit) = self.protection(sector);
            self.registers[register] &= !bit;
        }
    }

    pub fn set_brown_out_level(&mut self, level: u8) {
        let bor_lev = u32::from(3 - level.min(3)) << BOR_LEV.trailing_zeros();
        self.registers[0] = self.registers[0] & !BOR_LEV | bor_lev;
    }

    pub fn bor_lev(&self) -> u32 {
        (self.registers[0] & BOR_LEV) >> BOR_LEV.trailing_zeros()
    }

    /// Whether the sector cannot be programmed or erased.
    pub fn protects(&self, sector: u32) -> bool {
        let (register, bit) = self.protection(sector);
        self.registers[register] & bit == 0
    }

    /// The register and the bit that protect a sector.
    fn protection(&self, sector: u32) -> (usize, u32) {
        let highest = self.part.protection_bits().ilog2();
        match self.part.has_two_banks() {
            true => (sector as usize / 12, 1 << (16 + sector % 12)),
            false => (0, 1 << (16 + sector).min(highest)),
        }
    }

    pub fn optr(&self) -> u32 {
        self.optr
    }

    pub fn set_optr(&mut self, optr: u32) {
        self.optr = optr;
    }

    /// Whether an STM32G4 starts the boot loader in ROM, with the pin BOOT0 high or low (RM0440 2.6).
    pub fn starts_loader(&self, is_pin_high: bool) -> bool {
        if self.optr & NSWBOOT0 == 0 { self.optr & NBOOT0 == 0 } else { is_pin_high }
    }

    pub fn registers(&self) -> [u32; 2] {
        self.registers
    }
}
