//! PWR (RM0440 chapter 6): the voltage range, which limits HCLK, and the protection of the backup domain.

use crate::{
    Time,
    chip::{Problem, registers::Registers, system::Power},
};

const CR1: u32 = 0x00;
const CR5: u32 = 0x80;
const SR1: u32 = 0x10;
const SR2: u32 = 0x14;
const SCR: u32 = 0x18;

const CR1_DBP: u32 = 1 << 8;
/// Range 1 in VOS.
const RANGE_1: u32 = 1;
/// Range 1 has no boost.
const CR5_R1MODE: u32 = 1 << 8;

#[derive(Debug)]
pub struct Pwr {
    supply_mv: u32,
    regs: [u32; 33],
}

impl Pwr {
    /// The state after a reset, with 3.3 V.
    pub fn new() -> Self {
        let mut regs = [0; 33];
        regs[CR1 as usize / 4] = RANGE_1 << 9;
        regs[CR5 as usize / 4] = CR5_R1MODE;
        Self { supply_mv: 3_300, regs }
    }
}

impl Power for Pwr {
    fn backup_domain_is_writable(&self) -> bool {
        self.regs[CR1 as usize / 4] & CR1_DBP != 0
    }

    fn set_supply(&mut self, mv: u32) {
        self.supply_mv = mv;
    }

    fn supply(&self) -> u32 {
        self.supply_mv
    }

    fn max_hclk(&self) -> u32 {
        match self.regs[CR1 as usize / 4] >> 9 & 3 {
            RANGE_1 if self.is_boosted() => 170_000_000,
            RANGE_1 => 150_000_000,
            _ => 26_000_000,
        }
    }

    fn is_boosted(&self) -> bool {
        self.regs[CR5 as usize / 4] & CR5_R1MODE == 0
    }
}

impl Registers for Pwr {
    /// The supply remains the same.
    fn reset(&mut self, _: Time) {
        *self = Self { supply_mv: self.supply_mv, ..Self::new() };
    }

    /// The regulator changes its range at once; the voltage detector is not modelled.
    fn read(&mut self, offset: u32, _: Time) -> Option<u32> {
        self.regs.get(offset as usize / 4).copied()
    }

    fn write(&mut self, offset: u32, value: u32, _: Time) -> Result<(), Problem> {
        match offset {
            SR1 | SR2 | SCR => {}
            _ => *self.regs.get_mut(offset as usize / 4).ok_or(Problem::Unmodelled)? = value,
        }
        Ok(())
    }
}
