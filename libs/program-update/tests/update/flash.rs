//! A flash in memory whose cells are uncertain after a cut, and whose operations can fail.

use std::{cell::RefCell, rc::Rc};

use program_update::{Area, Flash, FlashError, ROW};
use testkit::random::Random;

const BLANK: u32 = u32::MAX;

#[derive(Clone, Debug)]
struct Cell {
    /// What it reads since the last start.
    reads: u32,
    /// What it may read at the next one; none if it is certain.
    may_read: Vec<u32>,
}

/// A kind of operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operation {
    Erase(Area),
    Program(Area, u32),
}

pub struct State {
    run: Vec<Cell>,
    backup: Vec<Cell>,
    random: Random,
    /// The operations that are completed before the power fails.
    pub cut_after: Option<usize>,
    pub has_power: bool,
    /// The operations so far, and whether one is under way.
    pub operations: Vec<Operation>,
    busy: u32,
    /// The polls that an operation takes.
    pub slow: u32,
    /// The operations that fail, with how.
    pub faults: Vec<(Operation, FlashError)>,
    /// Words that are programmed, but take no bits.
    pub stuck: Vec<(Area, u32)>,
    /// An operation that spoils a word, which is not its own.
    pub spoils: Option<(Operation, (Area, u32))>,
    outcome: Result<(), FlashError>,
}

/// Handles to a flash with sectors of 576 and 192 bytes in each area.
#[derive(Clone)]
pub struct Chip(pub Rc<RefCell<State>>);

pub const SECTORS: [u32; 2] = [576, 192];
const AREA: usize = 192;

impl Chip {
    pub fn blank(seed: u64) -> Self {
        let area = || vec![Cell { reads: BLANK, may_read: Vec::new() }; AREA];
        Self(Rc::new(RefCell::new(State {
            run: area(),
            backup: area(),
            random: Random::from_seed(seed),
            cut_after: None,
            has_power: true,
            operations: Vec::new(),
            busy: 0,
            slow: 0,
            faults: Vec::new(),
            stuck: Vec::new(),
            spoils: None,
            outcome: Ok(()),
        })))
    }

    /// A flash with a file in RUN.
    pub fn with(file: &[u8], seed: u64) -> Self {
        let chip = Self::blank(seed);
        chip.put(Area::Run, file);
        chip
    }

    pub fn put(&self, area: Area, file: &[u8]) {
        let mut state = self.0.borrow_mut();
        for (cell, word) in state.area(area).iter_mut().zip(crate::program::words(file)) {
            cell.reads = word;
        }
    }

    /// Whether the area begins with this file and no cell of it is uncertain.
    pub fn holds(&self, area: Area, file: &[u8]) -> bool {
        let mut state = self.0.borrow_mut();
        let words = crate::program::words(file);
        let journal = 112..126;
        state.area(area).iter().zip(words).enumerate().all(|(i, (cell, word))| {
            let is_journal = area == Area::Backup && journal.contains(&i);
            is_journal || cell.reads == word && cell.may_read.is_empty()
        })
    }

    /// Switches the power on: what is uncertain reads in some way.
    pub fn start(&self) {
        let state = &mut *self.0.borrow_mut();
        state.has_power = true;
        state.busy = 0;
        for cell in state.run.iter_mut().chain(&mut state.backup) {
            if !cell.may_read.is_empty() {
                cell.reads = state.random.pick(&cell.may_read);
            }
        }
    }

    /// The power fails within an operation, after so many others.
    pub fn cut_after(&self, operations: Option<usize>) {
        self.0.borrow_mut().cut_after = operations;
    }

    pub fn has_power(&self) -> bool {
        self.0.borrow().has_power
    }

    pub fn operations(&self) -> usize {
        self.0.borrow().operations.len()
    }
}

impl State {
    fn area(&mut self, area: Area) -> &mut Vec<Cell> {
        match area {
            Area::Run => &mut self.run,
            Area::Backup => &mut self.backup,
        }
    }

    /// Begins an operation; true if the power fails within it.
    fn begin(&mut self, operation: Operation) -> Result<bool, FlashError> {
        assert_eq!(self.busy, 0, "the flash is busy");
        if !self.has_power {
            self.busy = 1;
            return Ok(false);
        }
        self.operations.push(operation);
        self.busy = 1 + self.slow;
        if let Some((by, (area, offset))) = self.spoils
            && by == operation
        {
            self.area(area)[offset as usize / 4].reads = 0;
        }
        self.outcome = Ok(());
        let fault = self.faults.iter().find(|(fails, _)| *fails == operation);
        if let Some((_, how)) = fault.copied() {
            self.outcome = Err(how);
            if how != FlashError::Failed {
                self.busy = 0;
                return Err(how);
            }
        }
        let is_cut = self.cut_after == Some(0);
        self.cut_after = self.cut_after.and_then(|count| count.checked_sub(1));
        self.has_power = !is_cut;
        Ok(is_cut)
    }

    fn program(&mut self, area: Area, offset: u32, word: u32) -> Result<(), FlashError> {
        let had_power = self.has_power;
        let is_cut = self.begin(Operation::Program(area, offset))?;
        if !had_power || self.stuck.contains(&(area, offset)) {
            return Ok(());
        }
        let partly = self.random.u32();
        let cell = &mut self.area(area)[offset as usize / 4];
        if is_cut {
            let mut may_read = std::mem::take(&mut cell.may_read);
            may_read.extend([cell.reads, cell.reads & word, cell.reads & (word | partly)]);
            cell.may_read = may_read;
        } else {
            // What it may have read keeps only the bits that were not programmed.
            cell.reads &= word;
            cell.may_read.iter_mut().for_each(|value| *value &= word);
            if cell.may_read.iter().all(|value| *value == word) {
                cell.may_read.clear();
            }
        }
        Ok(())
    }
}

impl Flash for Chip {
    fn sectors(&self, _: Area) -> &'static [u32] {
        &SECTORS
    }

    fn read(&mut self, area: Area, offset: u32) -> u32 {
        let mut state = self.0.borrow_mut();
        assert_eq!(state.busy, 0, "a read while the flash is busy");
        state.area(area)[offset as usize / 4].reads
    }

    fn program(&mut self, area: Area, offset: u32, words: &[u32]) -> Result<(), FlashError> {
        assert!((1..=ROW).contains(&words.len()), "{} words", words.len());
        let mut state = self.0.borrow_mut();
        state.program(area, offset, words[0])?;
        for (word, i) in words.iter().zip(0..).skip(1) {
            if state.outcome.is_ok() {
                state.busy = 0;
                // The end shows how it fails.
                let _ = state.program(area, offset + 4 * i, *word);
                state.busy = 1 + state.slow;
            }
        }
        Ok(())
    }

    fn erase(&mut self, area: Area, sector: usize) -> Result<(), FlashError> {
        let mut state = self.0.borrow_mut();
        let had_power = state.has_power;
        let is_cut = state.begin(Operation::Erase(area))?;
        if !had_power {
            return Ok(());
        }
        let from = SECTORS[..sector].iter().sum::<u32>() as usize / 4;
        let to = from + SECTORS[sector] as usize / 4;
        let mut random = state.random.clone();
        state.random.u64();
        // The cells may fade in another order than that of their addresses.
        let kind = random.within(0..4);
        for cell in &mut state.area(area)[from..to] {
            if !is_cut {
                *cell = Cell { reads: BLANK, may_read: Vec::new() };
                continue;
            }
            let (reads, anything) = (cell.reads, cell.reads | random.u32());
            let is_rare = random.one_in(64);
            match kind {
                0 => cell.may_read.extend([reads, BLANK]),
                1 => cell.may_read.extend([reads, reads, reads, reads, reads, anything]),
                2 if is_rare => cell.may_read.extend([BLANK, anything]),
                2 => *cell = Cell { reads: BLANK, may_read: Vec::new() },
                _ if is_rare => cell.may_read.extend([reads, reads, BLANK]),
                _ => {}
            }
        }
        Ok(())
    }

    fn poll(&mut self) -> Option<Result<(), FlashError>> {
        let mut state = self.0.borrow_mut();
        state.busy -= 1;
        (state.busy == 0).then_some(state.outcome)
    }
}
