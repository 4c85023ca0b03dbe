//! The option bytes and the registers through which they are read and programmed (RM0090 3.7).

use crate::chip::{BusFault, Part, Problem};

const OPTLOCK: u32 = 1 << 0;
const OPTSTRT: u32 = 1 << 1;
const BOR_LEV: u32 = 0b11 << 2;
/// The options that the emulator models or that have no effect without a reset pin: BOR_LEV and nWRP.
const MODELLED: u32 = 0x0FFF_000C;

/// One of the two registers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Register {
    /// OPTCR: user option bytes and protection of the first 12 sectors.
    Optcr,
    /// OPTCR1 of parts with two banks: protection of the other sectors.
    Optcr1,
}

/// The option bytes.
#[derive(Debug)]
pub struct Options {
    /// The programmed content, as OPTCR and OPTCR1 show it after a reset.
    stored: [u32; 2],
    registers: [u32; 2],
    half_unlocked: bool,
    locked_until_reset: bool,
}

impl Options {
    /// The factory settings: no protection, the lowest brown-out level.
    pub fn new(part: Part) -> Self {
        let second = if part == Part::Stm32f427 { 0x0FFF_0000 } else { 0 };
        let stored = [0x0FFF_AAEC | OPTLOCK, second];
        Self { stored, registers: stored, half_unlocked: false, locked_until_reset: false }
    }

    /// Loads the registers from the programmed content.
    pub fn reset(&mut self) {
        self.registers = self.stored;
        self.half_unlocked = false;
        self.locked_until_reset = false;
    }

    /// Protects the sectors whose bit is 1, as a programming tool does.
    pub fn protect(&mut self, sectors: u32) {
        for (index, sectors) in [sectors, sectors >> 12].into_iter().enumerate() {
            self.stored[index] = self.stored[index] & !0x0FFF_0000 | (!sectors & 0xFFF) << 16;
            self.registers[index] = self.registers[index] & !0x0FFF_0000 | (!sectors & 0xFFF) << 16;
        }
    }

    /// Sets BOR_LEV, as a programming tool does.
    pub fn set_brown_out_level(&mut self, level: u8) {
        for word in [&mut self.stored[0], &mut self.registers[0]] {
            *word = *word & !BOR_LEV | u32::from(3 - level.min(3)) << BOR_LEV.trailing_zeros();
        }
    }

    /// The supply in mV below which the chip is held in reset (F405 data sheet, falling edge, typical).
    pub fn brown_out_mv(&self) -> u32 {
        match self.stored[0] & BOR_LEV {
            0b0000 => 2_830,
            0b0100 => 2_500,
            0b1000 => 2_190,
            _ => 1_680,
        }
    }

    /// Whether the sector cannot be programmed or erased.
    pub fn protects(&self, sector: u32) -> bool {
        self.stored[sector as usize / 12] >> (16 + sector % 12) & 1 == 0
    }

    /// The value of a register.
    pub fn read(&self, register: Register) -> u32 {
        self.registers[register as usize]
    }

    /// The word at `offset` of the option bytes at 1FFF_C000h.
    pub fn word(&self, offset: u32) -> Option<u32> {
        match offset {
            0 => Some(self.stored[0] & 0xFFFC | 0xFFFF_0003),
            8 => Some(self.stored[0] >> 16 | 0xFFFF_F000),
            _ => None,
        }
    }

    /// Accepts a key.
    pub fn write_key(&mut self, value: u32) -> Result<(), BusFault> {
        match (value, self.half_unlocked, self.locked_until_reset) {
            (0x0819_2A3B, false, false) => self.half_unlocked = true,
            (0x4C5D_6E7F, true, false) => {
                self.half_unlocked = false;
                self.registers[0] &= !OPTLOCK;
            }
            _ => {
                self.locked_until_reset = true;
                self.registers[0] |= OPTLOCK;
                return Err(BusFault);
            }
        }
        Ok(())
    }

    /// Writes a register. Returns true if the option bytes must be programmed now.
    pub fn write(&mut self, register: Register, value: u32) -> Result<bool, Problem> {
        if self.registers[0] & OPTLOCK != 0 {
            return Err(Problem::Misuse("option bytes written while they are locked"));
        }
        let present = &mut self.registers[register as usize];
        let changes = (*present ^ value) & !(MODELLED | OPTLOCK | OPTSTRT);
        *present = value & (MODELLED | OPTLOCK) | *present & !(MODELLED | OPTLOCK);
        if changes != 0 {
            return Err(Problem::Unmodelled);
        }
        Ok(register == Register::Optcr && value & OPTSTRT != 0)
    }

    /// Programs the content of the registers.
    pub fn program(&mut self) {
        self.stored = [self.registers[0] | OPTLOCK, self.registers[1]];
    }
}
