//! External control of the flash: a programming tool, staged faults, and counters.

use std::ops::Range;

use super::{Cells, Done, Flash, StuckBits, Timing};
use crate::Time;

/// A staged failure: the supply is cut in the middle of an operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PowerCut {
    /// The number of the operation (program or erase) since the board was made, from 0.
    pub operation: u64,
    /// Determines the moment within the operation and the content that remains.
    pub seed: u64,
}

impl Flash {
    /// Stores bytes at `offset` from the start of the flash, as a programming tool does.
    pub fn load(&mut self, offset: u32, bytes: &[u8]) {
        self.array.load(offset, bytes);
        self.note_change(offset as usize..offset as usize + bytes.len());
    }

    /// Selects typical or guaranteed times.
    pub fn set_timing(&mut self, timing: Timing) {
        self.timing = timing;
    }

    /// Protects the sectors whose bit is 1 against programming and erasing (nWRP of the option bytes, inverted).
    pub fn protect_sectors(&mut self, sectors: u32) {
        self.options.protect(sectors);
    }

    /// Sets the brown-out level in the option bytes: 0, as from the factory, to 3.
    pub fn set_brown_out_level(&mut self, level: u8) {
        self.options.set_brown_out_level(level);
    }

    /// Sets FLASH_OPTR of an STM32G4 as a programming tool does.
    pub fn set_option_register(&mut self, optr: u32) {
        self.options.set_optr(optr);
    }

    /// Sets the supply in mV, which limits the width of programming.
    pub(in crate::chip) fn set_supply(&mut self, mv: u32) {
        self.supply_mv = mv;
    }

    pub fn cut_power(&mut self, cut: PowerCut) {
        self.power_cut = Some(cut);
    }

    pub fn add_stuck_bits(&mut self, bits: StuckBits) {
        self.array.add_stuck(bits);
        self.note_change(bits.offset as usize..bits.offset as usize + 1);
    }

    /// Gives the double word of an STM32G4 at `offset` a double error, until it is programmed again or erased.
    pub fn damage(&mut self, offset: u32) {
        self.array.damage(offset);
        self.note_change(offset as usize..offset as usize + 8);
    }

    /// Lets the failures that are staged begin with the operation of this number.
    pub fn fail_from(&mut self, operation: u64) {
        self.failing_from = operation;
    }

    /// Makes the next `count` erases leave random content, made from `seed`, in the sector, without an error flag.
    pub fn fail_erases(&mut self, count: u32, seed: u64) {
        self.failing_erases = count;
        self.failing_erase_seed = seed;
    }

    /// Makes each of the next `count` program operations leave a bit unprogrammed, without an error flag.
    pub fn fail_programs(&mut self, count: u32) {
        self.failing_programs = count;
    }

    /// Makes each of the next `count` program operations end at once with PGSERR, without an effect.
    pub fn refuse_programs(&mut self, count: u32) {
        self.refused_programs = count;
    }

    /// The cells as they are.
    pub fn cells(&self) -> Cells {
        self.array.clone()
    }

    /// Puts the cells of another flash of the same part in place of these, while the power is off.
    pub fn set_cells(&mut self, cells: Cells) {
        self.note_change(0..cells.bytes().len());
        self.array = cells;
    }

    /// Each operation since the board was made.
    pub fn done(&self) -> &[Done] {
        &self.done
    }

    /// The number of program and erase operations started since the board was made.
    pub fn operations(&self) -> u64 {
        self.operations.len() as u64
    }

    /// The time span of each operation, or its intended one if the power failed.
    pub fn operation_times(&self) -> &[Range<Time>] {
        &self.operations
    }
}
