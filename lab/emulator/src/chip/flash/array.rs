//! The flash cells: sectors, programming that only clears bits, and the content after a power cut.

use std::{collections::BTreeSet, ops::Range};

use crate::chip::{Part, part::Family};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StuckBits {
    /// Byte offset from the start of the flash.
    pub offset: u32,
    pub mask: u8,
    pub value: u8,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Program,
    Erase,
}

/// An operation that was done on cells: others of the same content can repeat it.
#[derive(Clone, Debug)]
pub struct Done {
    kind: Kind,
    range: Range<usize>,
    /// What was programmed.
    bytes: Vec<u8>,
}

/// The length of a page of an STM32G4.
const PAGE: u32 = 2 * 1024;

/// Cells between two values, because their programming was interrupted.
#[derive(Clone, Debug)]
struct Marginal {
    start: usize,
    before: Vec<u8>,
    programmed: Vec<u8>,
    random: Random,
}

/// The cells of the whole main memory.
#[derive(Clone, Debug)]
pub struct Cells {
    part: Part,
    bytes: Vec<u8>,
    stuck: Vec<StuckBits>,
    marginal: Vec<Marginal>,
    /// The double words of an STM32G4 that have a double error.
    double_errors: BTreeSet<u32>,
}

impl Cells {
    /// An erased flash.
    pub fn new(part: Part) -> Self {
        let bytes = vec![0xFF; part.flash_size() as usize];
        let (stuck, marginal, double_errors) = Default::default();
        Self { part, bytes, stuck, marginal, double_errors }
    }

    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Replaces the content from `offset` on, as a programming tool does.
    pub fn load(&mut self, offset: u32, bytes: &[u8]) {
        let start = offset as usize;
        self.bytes[start..start + bytes.len()].copy_from_slice(bytes);
        self.forget_damage(&(start..start + bytes.len()));
        self.apply_stuck(start..start + bytes.len());
    }

    pub fn add_stuck(&mut self, bits: StuckBits) {
        self.stuck.push(bits);
        self.apply_stuck(bits.offset as usize..bits.offset as usize + 1);
    }

    fn apply_stuck(&mut self, range: Range<usize>) {
        for bits in &self.stuck {
            let offset = bits.offset as usize;
            if range.contains(&offset) {
                let byte = &mut self.bytes[offset];
                *byte = *byte & !bits.mask | bits.value & bits.mask;
            }
        }
    }

    /// The bank of sector number `sector`, and its number there.
    pub fn place(&self, sector: u32) -> (u32, u32) {
        if self.part.has_two_banks() { (sector / 12, sector % 12) } else { (0, sector) }
    }

    /// The byte range of sector number `sector` (RM0090 tables 5 and 6), if the part has it; on an STM32G4 of a page.
    pub fn sector(&self, sector: u32) -> Option<Range<usize>> {
        const KB: u32 = 1024;
        let (bank, index) = self.place(sector);
        let (start, length) = match index {
            _ if self.part.family() == Family::G4 => (sector * PAGE, PAGE),
            0..4 => (index * 16 * KB, 16 * KB),
            4 => (64 * KB, 64 * KB),
            _ => ((index - 4) * 128 * KB, 128 * KB),
        };
        let start = bank * self.part.flash_bank_size() + start;
        let end = start + length;
        (end <= self.part.flash_size()).then_some(start as usize..end as usize)
    }

    /// The number of the sector that holds byte `offset`.
    pub fn sector_of(&self, offset: u32) -> u32 {
        let bank = offset / self.part.flash_bank_size();
        let sector = match offset % self.part.flash_bank_size() / 1024 {
            kb @ 0..64 => kb / 16,
            64..128 => 4,
            kb => 4 + kb / 128,
        };
        bank * 12 + sector
    }

    /// Programs bytes: bits can change from 1 to 0 only.
    pub fn program(&mut self, offset: u32, bytes: &[u8]) {
        let start = offset as usize;
        for (cell, byte) in self.bytes[start..].iter_mut().zip(bytes) {
            *cell &= byte;
        }
        self.forget_double_errors(&(start..start + bytes.len()));
        for marginal in &mut self.marginal {
            for (at, &byte) in (start..).zip(bytes) {
                if let Some(index) = at.checked_sub(marginal.start)
                    && index < marginal.before.len()
                {
                    marginal.before[index] &= byte;
                    marginal.programmed[index] &= byte;
                }
            }
        }
        self.marginal.retain(|marginal| marginal.before != marginal.programmed);
        self.apply_stuck(start..start + bytes.len());
    }

    /// Sets all bits of a range.
    pub fn erase(&mut self, range: Range<usize>) {
        self.bytes[range.clone()].fill(0xFF);
        self.forget_damage(&range);
        self.apply_stuck(range);
    }

    /// Marks cells whose programming will be interrupted as between two values.
    fn add_marginal(&mut self, start: usize, before: &[u8], seed: u64) {
        let programmed = self.bytes[start..start + before.len()].to_vec();
        let (before, random) = (before.to_vec(), Random(!seed));
        self.marginal.push(Marginal { start, before, programmed, random });
    }

    fn forget_damage(&mut self, range: &Range<usize>) {
        self.marginal.retain(|marginal| !range.contains(&marginal.start));
        self.forget_double_errors(range);
    }

    fn forget_double_errors(&mut self, range: &Range<usize>) {
        self.double_errors.retain(|word| !range.contains(&(*word as usize)));
    }

    /// Gives a double word a double error.
    pub fn damage(&mut self, offset: u32) {
        self.double_errors.insert(offset & !7);
    }

    /// The offsets of the double words with a double error, in order.
    pub fn double_errors(&self) -> impl Iterator<Item = u32> {
        self.double_errors.iter().copied()
    }

    /// Makes every cell between two values read as either; returns their positions.
    pub fn flip_marginal(&mut self) -> Vec<Range<usize>> {
        let mut ranges = Vec::new();
        for Marginal { start, before, programmed, random } in &mut self.marginal {
            let kind = random.next() % 4;
            for ((cell, old), new) in
                self.bytes[*start..].iter_mut().zip(&*before).zip(&*programmed)
            {
                *cell = match kind {
                    0 => *old,
                    1 => *new,
                    _ => *old & (*new | random.next() as u8),
                };
            }
            ranges.push(*start..*start + before.len());
        }
        ranges.iter().for_each(|range| self.apply_stuck(range.clone()));
        ranges
    }

    /// An operation that has just been done.
    pub(super) fn done(&self, kind: Kind, range: Range<usize>) -> Done {
        let bytes = match kind {
            Kind::Program => self.bytes[range.clone()].to_vec(),
            Kind::Erase => Vec::new(),
        };
        Done { kind, range, bytes }
    }

    /// Repeats an operation that cells of this content have done.
    pub fn repeat(&mut self, done: &Done) {
        match done.kind {
            Kind::Program => self.program(done.range.start as u32, &done.bytes),
            Kind::Erase => self.erase(done.range.clone()),
        }
    }

    /// Repeats it up to a power cut; then a word may read differently at each power-on, if cut words flip.
    pub fn repeat_until_cut(&mut self, done: &Done, cut_words_flip: bool, seed: u64) {
        let before = self.bytes[done.range.clone()].to_vec();
        self.repeat(done);
        self.tear(done.kind, done.range.start, &before, cut_words_flip, seed);
    }

    /// The result of an interrupted operation.
    pub(super) fn tear(
        &mut self,
        kind: Kind,
        start: usize,
        before: &[u8],
        cut_words_flip: bool,
        seed: u64,
    ) {
        match kind {
            // What ECC makes of the cells is not known.
            Kind::Program if self.part.family() == Family::G4 => {
                self.tear_unit(start, before, seed);
            }
            Kind::Program => {
                if cut_words_flip {
                    self.add_marginal(start, before, seed);
                }
                self.tear_program(start, before, seed);
            }
            Kind::Erase => self.tear_erase(start, before, seed),
        }
    }

    /// The result of an interrupted program operation: each bit to be cleared may or may not be.
    fn tear_program(&mut self, start: usize, before: &[u8], seed: u64) {
        let mut random = Random(seed);
        for (cell, &old) in self.bytes[start..].iter_mut().zip(before) {
            let cleared = old & !*cell;
            *cell = old & !(cleared & random.next() as u8);
        }
        self.apply_stuck(start..start + before.len());
    }

    /// The result of an interrupted program operation with ECC: the old content, the new one, or a double error with any
    /// content.
    fn tear_unit(&mut self, start: usize, before: &[u8], seed: u64) {
        let mut random = Random(seed);
        let cells = &mut self.bytes[start..start + before.len()];
        match random.next() % 3 {
            0 => cells.copy_from_slice(before),
            1 => {}
            _ => {
                cells.iter_mut().for_each(|cell| *cell = random.next() as u8);
                self.double_errors.insert(start as u32);
            }
        }
        self.apply_stuck(start..start + before.len());
    }

    /// The result of an interrupted erase: for each 32 bytes the old content, erased cells, or anything, which on an
    /// STM32G4 are double errors.
    pub fn tear_erase(&mut self, start: usize, before: &[u8], seed: u64) {
        let mut random = Random(seed);
        let has_ecc = self.part.family() == Family::G4;
        for ((cells, old), at) in self.bytes[start..start + before.len()]
            .chunks_mut(32)
            .zip(before.chunks(32))
            .zip((start as u32..).step_by(32))
        {
            match random.next() % 3 {
                0 => cells.copy_from_slice(old),
                1 => cells.fill(0xFF),
                _ => {
                    cells.iter_mut().for_each(|cell| *cell = random.next() as u8);
                    let words = (at..at + 32).step_by(8).filter(|_| has_ecc);
                    self.double_errors.extend(words);
                }
            }
        }
        self.apply_stuck(start..start + before.len());
    }
}

/// SplitMix64: small, seeded, the same on every host.
#[derive(Clone, Debug)]
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ z >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ z >> 31
    }
}
