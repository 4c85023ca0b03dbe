//! The option bytes and the registers through which they are read and programmed (RM0090 3.7).

use super::Lock;
use crate::chip::{Part, Problem};

const OPTLOCK: u32 = 1 << 0;
const OPTSTRT: u32 = 1 << 1;
const BOR_LEV: u32 = 0b11 << 2;

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
    part: Part,
    /// The programmed content, as OPTCR and OPTCR1 show it after a reset.
    stored: [u32; 2],
    registers: [u32; 2],
    lock: Lock,
}

/// The nWRP bits of both registers without any protection.
fn unprotected(part: Part) -> [u32; 2] {
    let bits = part.protection_bits();
    [bits, if part.has_two_banks() { bits } else { 0 }]
}

impl Options {
    /// The factory settings: no protection, the lowest brown-out level.
    pub fn new(part: Part) -> Self {
        let [first, second] = unprotected(part);
        let stored = [first | 0xAAEC | OPTLOCK, second];
        Self { part, stored, registers: stored, lock: Lock::default() }
    }

    /// Loads the registers from the programmed content.
    pub fn reset(&mut self) {
        self.registers = self.stored;
        self.lock = Lock::default();
    }

    /// Protects the sectors whose bit is 1, and no others, as a programming tool does.
    pub fn protect(&mut self, sectors: u32) {
        let mut bits = unprotected(self.part);
        for sector in (0..28).filter(|sector| sectors >> sector & 1 == 1) {
            let (register, bit) = self.protection(sector);
            bits[register] &= !bit;
        }
        for registers in [&mut self.stored, &mut self.registers] {
            for (register, bits) in registers.iter_mut().zip(bits) {
                *register = *register & !self.part.protection_bits() | bits;
            }
        }
    }

    /// Sets BOR_LEV, as a programming tool does.
    pub fn set_brown_out_level(&mut self, level: u8) {
        for word in [&mut self.stored[0], &mut self.registers[0]] {
            *word = *word & !BOR_LEV | u32::from(3 - level.min(3)) << BOR_LEV.trailing_zeros();
        }
    }

    /// BOR_LEV as programmed.
    pub fn bor_lev(&self) -> u32 {
        (self.stored[0] & BOR_LEV) >> BOR_LEV.trailing_zeros()
    }

    /// Whether the sector cannot be programmed or erased.
    pub fn protects(&self, sector: u32) -> bool {
        let (register, bit) = self.protection(sector);
        self.stored[register] & bit == 0
    }

    /// The register and the bit that protect a sector.
    fn protection(&self, sector: u32) -> (usize, u32) {
        let highest = self.part.protection_bits().ilog2();
        match self.part.has_two_banks() {
            true => (sector as usize / 12, 1 << (16 + sector % 12)),
            false => (0, 1 << (16 + sector).min(highest)),
        }
    }

    /// The options that the emulator models or that have no effect without a reset pin: BOR_LEV and nWRP.
    fn modelled(&self) -> u32 {
        self.part.protection_bits() | BOR_LEV
    }

    /// The value of a register.
    pub fn read(&self, register: Register) -> u32 {
        self.registers[register as usize]
    }

    /// The word at `offset` of the option bytes at 1FFF_C000h.
    pub fn word(&self, offset: u32) -> Option<u32> {
        match offset {
            0 => Some(self.stored[0] & 0xFFFC | 0xFFFF_0003),
            8 => Some(self.stored[0] >> 16 | !(self.part.protection_bits() >> 16)),
            _ => None,
        }
    }

    /// Accepts a key.
    pub fn write_key(&mut self, value: u32) -> Result<(), Problem> {
        self.lock.accept(value, [0x0819_2A3B, 0x4C5D_6E7F], &mut self.registers[0], OPTLOCK)
    }

    /// Writes a register. Returns true if the option bytes must be programmed now.
    pub fn write(&mut self, register: Register, value: u32) -> Result<bool, Problem> {
        if self.registers[0] & OPTLOCK != 0 {
            return Err(Problem::Misuse("option bytes written while they are locked"));
        }
        let writable = self.modelled() | OPTLOCK;
        let present = &mut self.registers[register as usize];
        let changes = (*present ^ value) & !(writable | OPTSTRT);
        *present = value & writable | *present & !writable;
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
