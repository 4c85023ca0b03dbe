//! A NOR flash in memory. Its power can fail in every program and erase step, its operations can fail, and its bits can
//! stick. Each unit is programmed once after an erase, whatever its content is.
//!
//! A unit whose programming was interrupted or failed, and each unit of a sector whose erase was, is torn: it reads as
//! blank, as written, as anything or as an error, differently each time. If it is programmed once more, that is refused
//! or completes the same content.
//!
//! Tests spend their time here. The workspace builds this crate with optimisation, so nothing in `Chip` is generic.

pub mod random;

use std::{cell::RefCell, ops::Range, rc::Rc};

use embedded_storage::nor_flash::{ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash};

use random::Random;

/// Two sectors of 16 KB, written a word at a time, as on the board.
pub type BoardFlash = Flash<4, 0x4000>;

/// A flash of sectors of `ERASE` bytes, two unless said otherwise, written in units of `WRITE` bytes; clones are
/// handles to the same chip.
#[derive(Clone)]
pub struct Flash<const WRITE: usize, const ERASE: usize>(Rc<RefCell<Chip>>);

/// A kind of operation that can be made to fail.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operation {
    Read,
    /// The programming of one unit; a failure leaves it torn.
    Write,
    /// The erasure of one sector; a failure leaves it torn.
    Erase,
    /// Any of these.
    Any,
}

/// What a flash that dies leaves of the unit that it programs.
#[derive(Clone, Copy, Debug)]
pub enum Left {
    Nothing,
    SomeBits,
    All,
}

#[derive(Clone)]
struct Chip {
    bytes: Vec<u8>,
    /// The length of a program unit.
    unit: usize,
    /// The length of a sector.
    sector: usize,
    /// The units that were programmed since their erase.
    programmed: Vec<bool>,
    /// The addresses of the units whose programming was interrupted.
    torn: Vec<usize>,
    /// Whether the erase of each sector was interrupted.
    half_erased: Vec<bool>,
    /// The number of the power-on.
    power_on: u64,
    /// The bits that are stuck at 0 (at 1), by address.
    stuck: Vec<(usize, u8, bool)>,
    random: Random,
    powered: bool,
    /// The number of program and erase steps that are completed before the power fails.
    steps_until_cut: Option<usize>,
    /// The operation to fail, the number of successful ones before it, and whether it fails only once.
    fault: Option<(Operation, usize, bool)>,
    /// What a failed operation leaves of its unit if it does not leave it torn.
    left: Option<Left>,
    /// An operation has failed.
    has_failed: bool,
    writes: usize,
    erases: usize,
}

impl<const WRITE: usize, const ERASE: usize> Flash<WRITE, ERASE> {
    /// A new, blank chip. `seed` determines the results of interrupted operations.
    pub fn blank(seed: u64) -> Self {
        Self::with_content(vec![0xFF; 2 * ERASE], seed)
    }

    /// A new, blank chip with this number of sectors in each half.
    pub fn blank_with_sectors(sectors: usize, seed: u64) -> Self {
        Self::with_content(vec![0xFF; 2 * sectors * ERASE], seed)
    }

    /// The length of `bytes` is that of all sectors.
    pub fn with_content(bytes: Vec<u8>, seed: u64) -> Self {
        Self(Rc::new(RefCell::new(Chip::new(bytes, WRITE, ERASE, seed))))
    }

    /// A copy of the chip with the same cells, powered on.
    pub fn duplicate(&self, seed: u64) -> Self {
        Self(Rc::new(RefCell::new(self.0.borrow().duplicate(seed))))
    }

    pub fn content(&self) -> Vec<u8> {
        self.0.borrow().bytes.clone()
    }

    /// Changes the content of a cell behind the log's back.
    pub fn corrupt(&self, at: usize, byte: u8) {
        let mut chip = self.0.borrow_mut();
        chip.bytes[at] = byte;
        chip.programmed[at / WRITE] |= byte != 0xFF;
    }

    /// Makes the bits `mask` of the byte at `at` stick at `value`.
    pub fn stick(&self, at: usize, mask: u8, value: bool) {
        self.0.borrow_mut().stuck.push((at, mask, value));
    }

    /// Makes the power fail in the program or erase step after the next `steps`.
    pub fn cut_power_after(&self, steps: usize) {
        self.0.borrow_mut().steps_until_cut = Some(steps);
    }

    pub fn is_powered(&self) -> bool {
        self.0.borrow().powered
    }

    /// Restores the power, without another failure.
    pub fn power_on(&self) {
        let mut chip = self.0.borrow_mut();
        chip.powered = true;
        chip.steps_until_cut = None;
        chip.flip();
    }

    /// Cycles the power: torn units read differently.
    pub fn cycle_power(&self) {
        self.0.borrow_mut().flip();
    }

    /// Makes every operation of this kind fail from now on.
    pub fn fail(&self, operation: Operation) {
        self.fail_after(operation, 0);
    }

    /// Makes every operation of this kind fail, after `others` that succeed.
    pub fn fail_after(&self, operation: Operation, others: usize) {
        self.0.borrow_mut().fault = Some((operation, others, false));
    }

    /// Makes one operation of this kind fail, after `others` that succeed.
    pub fn fail_once(&self, operation: Operation, others: usize) {
        self.0.borrow_mut().fault = Some((operation, others, true));
    }

    /// Makes every operation of this kind fail, after `others` that succeed. It leaves so much of its unit.
    pub fn die_after(&self, operation: Operation, others: usize, left: Left) {
        self.fail_after(operation, others);
        self.0.borrow_mut().left = Some(left);
    }

    /// Whether a requested failure has come.
    pub fn has_died(&self) -> bool {
        self.0.borrow().has_failed
    }

    /// Whether the requested failure is still to come or persists.
    pub fn is_faulty(&self) -> bool {
        self.0.borrow().fault.is_some()
    }

    pub fn repair(&self) {
        let mut chip = self.0.borrow_mut();
        (chip.fault, chip.left) = (None, None);
        chip.stuck.clear();
    }

    /// The number of units programmed.
    pub fn writes(&self) -> usize {
        self.0.borrow().writes
    }

    /// The number of sectors erased.
    pub fn erases(&self) -> usize {
        self.0.borrow().erases
    }
}

impl Chip {
    fn new(bytes: Vec<u8>, unit: usize, sector: usize, seed: u64) -> Self {
        assert!(bytes.len().is_multiple_of(2 * sector));
        let is_programmed = |unit: &[u8]| unit.iter().any(|&byte| byte != 0xFF);
        Self {
            programmed: bytes.chunks(unit).map(is_programmed).collect(),
            torn: Vec::new(),
            half_erased: vec![false; bytes.len() / sector],
            power_on: seed,
            bytes,
            unit,
            sector,
            stuck: Vec::new(),
            random: Random::from_seed(seed),
            powered: true,
            steps_until_cut: None,
            fault: None,
            left: None,
            has_failed: false,
            writes: 0,
            erases: 0,
        }
    }

    fn duplicate(&self, seed: u64) -> Self {
        let mut duplicate = Self {
            bytes: self.bytes.clone(),
            programmed: self.programmed.clone(),
            torn: self.torn.clone(),
            half_erased: self.half_erased.clone(),
            stuck: self.stuck.clone(),
            ..Self::new(Vec::new(), self.unit, self.sector, seed)
        };
        duplicate.flip();
        duplicate
    }

    fn byte(&self, at: usize) -> u8 {
        self.stuck.iter().filter(|stuck| stuck.0 == at).fold(self.bytes[at], |byte, stuck| {
            if stuck.2 { byte | stuck.1 } else { byte & !stuck.1 }
        })
    }

    /// Whether the next operation is completed.
    fn succeeds(&mut self, operation: Operation) -> bool {
        if operation != Operation::Read {
            match &mut self.steps_until_cut {
                Some(0) => self.powered = false,
                Some(steps) => *steps -= 1,
                None => {}
            }
        }
        if let Some((kind, others, once)) = &mut self.fault
            && (*kind == operation || *kind == Operation::Any)
        {
            if *others > 0 {
                *others -= 1;
            } else {
                if *once {
                    self.fault = None;
                }
                self.has_failed = true;
                return false;
            }
        }
        self.powered
    }

    fn read(&mut self, at: usize, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        if !self.powered || !self.succeeds(Operation::Read) {
            return Err(NorFlashErrorKind::Other);
        }
        bytes.copy_from_slice(&self.bytes[at..at + bytes.len()]);
        if !self.torn.is_empty() || self.half_erased.contains(&true) {
            for (at, unit) in (at..).step_by(self.unit).zip(bytes.chunks_mut(self.unit)) {
                self.tear(at, unit)?;
            }
        }
        if !self.stuck.is_empty() {
            bytes.iter_mut().zip(at..).for_each(|(byte, at)| *byte = self.byte(at));
        }
        Ok(())
    }

    fn write(&mut self, at: usize, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        for (at, unit) in (at..).step_by(self.unit).zip(bytes.chunks(self.unit)) {
            if !self.powered {
                return Err(NorFlashErrorKind::Other);
            }
            self.program(at, unit)?;
        }
        Ok(())
    }

    fn erase(&mut self, sectors: Range<usize>) -> Result<(), NorFlashErrorKind> {
        for at in sectors.step_by(self.sector) {
            if !self.powered {
                return Err(NorFlashErrorKind::Other);
            }
            self.erase_sector(at)?;
        }
        Ok(())
    }

    fn program(&mut self, at: usize, unit: &[u8]) -> Result<(), NorFlashErrorKind> {
        let place = at..at + unit.len();
        let sector = at / self.sector;
        let programmed = &mut self.programmed[at / unit.len()];
        // Where the power was cut in the first unit of a place.
        let was_torn = self.torn.contains(&at) && self.bytes[place.clone()] == *unit;
        assert!(!*programmed || was_torn, "address {at:#x} is programmed twice");
        assert!(
            !self.half_erased[sector],
            "address {at:#x} is programmed after an incomplete erase"
        );
        *programmed = true;
        self.writes += 1;
        let succeeds = self.succeeds(Operation::Write);
        if let (false, true, Some(left)) = (succeeds, self.powered, self.left) {
            match left {
                Left::Nothing => self.programmed[at / unit.len()] = false,
                Left::SomeBits => {
                    let cells = self.bytes[place].iter_mut().zip(unit);
                    cells.for_each(|(cell, byte)| *cell &= byte | self.random.byte());
                    let left = &self.bytes[at..at + unit.len()];
                    self.programmed[at / unit.len()] = left.iter().any(|byte| *byte != 0xFF);
                }
                Left::All => self.bytes[place].copy_from_slice(unit),
            }
            return Err(NorFlashErrorKind::Other);
        }
        self.bytes[place].copy_from_slice(unit);
        let is_refused = was_torn && self.random.one_in(2);
        if succeeds && !is_refused {
            self.torn.retain(|torn| *torn != at);
            return Ok(());
        }
        if !was_torn {
            self.torn.push(at);
        }
        Err(NorFlashErrorKind::Other)
    }

    /// What a unit reads as this time. From one power-on to the next all of a sector whose erase was interrupted may
    /// read the same, and so may a torn unit.
    fn tear(&mut self, at: usize, unit: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        let sector = at / self.sector;
        let torn = if self.half_erased[sector] {
            sector
        } else if self.torn.contains(&at) {
            at
        } else {
            return Ok(());
        };
        let same = Random::from_seed(self.power_on ^ torn as u64).within(0..5);
        let random = &mut self.random;
        match if same < 3 { same } else { random.within(0..6) } {
            0 => unit.fill(0xFF),
            1 => {}
            2 => {
                let mut random = Random::from_seed(self.power_on ^ at as u64);
                unit.iter_mut().for_each(|byte| *byte |= random.byte());
            }
            3 => unit.iter_mut().for_each(|byte| *byte |= random.byte()),
            // As often in a place of small units as in one of words: else a start could read no place of two banks.
            5 if unit.len() >= 4 || random.one_in(4 / unit.len() as u64) => {
                return Err(NorFlashErrorKind::Other);
            }
            _ => unit.fill_with(|| random.byte()),
        }
        Ok(())
    }

    /// Makes torn units read otherwise.
    fn flip(&mut self) {
        self.power_on = self.random.u64();
    }

    fn erase_sector(&mut self, at: usize) -> Result<(), NorFlashErrorKind> {
        self.erases += 1;
        let place = at..at + self.sector;
        self.programmed[place.start / self.unit..place.end / self.unit].fill(false);
        self.torn.retain(|torn| !place.contains(torn));
        let succeeds = self.succeeds(Operation::Erase);
        self.half_erased[at / self.sector] = !succeeds;
        if succeeds {
            self.bytes[place].fill(0xFF);
            return Ok(());
        }
        Err(NorFlashErrorKind::Other)
    }
}

/// Panics unless an operation begins and ends with a unit; one outside of the flash panics later.
fn check(at: u32, len: usize, unit: usize) {
    assert!((at as usize | len).is_multiple_of(unit), "{len} bytes at {at:#x} are not whole units");
}

impl<const WRITE: usize, const ERASE: usize> ErrorType for Flash<WRITE, ERASE> {
    type Error = NorFlashErrorKind;
}

impl<const WRITE: usize, const ERASE: usize> ReadNorFlash for Flash<WRITE, ERASE> {
    const READ_SIZE: usize = if WRITE < 8 { 1 } else { WRITE };

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        check(offset, bytes.len(), Self::READ_SIZE);
        self.0.borrow_mut().read(offset as usize, bytes)
    }

    fn capacity(&self) -> usize {
        self.0.borrow().bytes.len()
    }
}

impl<const WRITE: usize, const ERASE: usize> NorFlash for Flash<WRITE, ERASE> {
    const WRITE_SIZE: usize = WRITE;
    const ERASE_SIZE: usize = ERASE;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        check(from, (to - from) as usize, ERASE);
        self.0.borrow_mut().erase(from as usize..to as usize)
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        check(offset, bytes.len(), WRITE);
        self.0.borrow_mut().write(offset as usize, bytes)
    }
}
