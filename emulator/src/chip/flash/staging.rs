//! What happens to the flash from outside of the program: a programming tool, faults to be staged, and what was counted.

use std::ops::Range;

use super::{Flash, StuckBits, Timing};
use crate::Time;

/// A failure to be staged: the supply goes away in the middle of an operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PowerCut {
    /// Which operation (program or erase) since the board was made, counted from 0.
    pub operation: u64,
    /// Chooses the moment within the operation and what it leaves.
    pub seed: u64,
}

impl Flash {
    /// Stores bytes at `offset` from the start of the flash, as a programming tool does.
    pub fn load(&mut self, offset: u32, bytes: &[u8]) {
        self.array.load(offset, bytes);
        self.note_change(offset as usize..offset as usize + bytes.len());
    }

    /// Chooses typical, guaranteed or longest times.
    pub fn set_timing(&mut self, timing: Timing) {
        self.timing = timing;
    }

    /// Protects the sectors whose bit is 1 against programming and erasing (nWRP of the option bytes, inverted).
    pub fn protect_sectors(&mut self, sectors: u32) {
        self.options.protect(sectors);
    }

    /// Sets the supply in mV, on which the possible width of programming depends.
    pub(in crate::chip) fn set_supply(&mut self, mv: u32) {
        self.supply_mv = mv;
    }

    /// Lets words whose programming is cut off from now on read otherwise at each power-on.
    pub fn let_cut_words_flip(&mut self, flip: bool) {
        self.cut_words_flip = flip;
    }

    /// Cuts the power at an operation to come.
    pub fn cut_power(&mut self, cut: PowerCut) {
        self.power_cut = Some(cut);
    }

    /// Makes bits that do not change any more.
    pub fn add_stuck_bits(&mut self, bits: StuckBits) {
        self.array.add_stuck(bits);
        self.note_change(bits.offset as usize..bits.offset as usize + 1);
    }

    /// Lets the next `count` erases leave anything, made from `seed`, in the sector, without an error flag.
    pub fn fail_erases(&mut self, count: u32, seed: u64) {
        self.failing_erases = count;
        self.failing_erase_seed = seed;
    }

    /// Lets each of the next `count` program operations leave a bit unprogrammed, without an error flag.
    pub fn fail_programs(&mut self, count: u32) {
        self.failing_programs = count;
    }

    /// How many program and erase operations were started since the board was made.
    pub fn operations(&self) -> u64 {
        self.operations.len() as u64
    }

    /// When each of them ran, or would have if the power had not failed.
    pub fn operation_times(&self) -> &[Range<Time>] {
        &self.operations
    }
}
