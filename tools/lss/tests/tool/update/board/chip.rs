//! The flash with the two areas of programs.

use std::{cell::RefCell, rc::Rc};

use program_update::{Area, Flash, FlashError};

/// The sectors of RUN and of BACKUP.
pub const SECTORS: [u32; 2] = [0x2000, 0x2000];

/// The flash.
pub struct Chip {
    run: Vec<u8>,
    backup: Vec<u8>,
    now: u64,
    ready_at: u64,
    end: Option<Result<(), FlashError>>,
    /// The sectors that were erased so far.
    pub erases: usize,
    /// The time of an erase in microseconds.
    pub erase_us: u64,
    /// What each operation ends with.
    pub fault: Option<FlashError>,
}

/// A handle to it.
#[derive(Clone)]
pub struct ChipFlash(pub Rc<RefCell<Chip>>);

impl Chip {
    /// The flash with this file in RUN.
    pub fn new(file: &[u8]) -> Self {
        let mut run = vec![0xFF; SECTORS.iter().sum::<u32>() as usize];
        let backup = run.clone();
        run[..file.len()].copy_from_slice(file);
        Self {
            run,
            backup,
            now: 0,
            ready_at: 0,
            end: None,
            erases: 0,
            erase_us: 100_000,
            fault: None,
        }
    }

    /// Lets time pass.
    pub fn pass_until(&mut self, now: u64) {
        self.now = now;
    }

    /// Whether an operation goes on.
    pub fn is_busy(&self) -> bool {
        self.now < self.ready_at
    }

    /// Ends the operation under way, which is as if done.
    pub fn power_off(&mut self) {
        (self.end, self.ready_at) = (None, 0);
    }

    /// A word of RUN.
    pub fn word(&self, offset: usize) -> u32 {
        self.run[offset..].first_chunk().copied().map_or(0, u32::from_le_bytes)
    }

    fn area(&mut self, area: Area) -> &mut [u8] {
        match area {
            Area::Run => &mut self.run,
            Area::Backup => &mut self.backup,
        }
    }

    fn begin(&mut self, us: u64) -> bool {
        assert!(self.end.is_none(), "one operation at a time");
        self.ready_at = self.now + us;
        self.end = Some(self.fault.map_or(Ok(()), Err));
        self.fault.is_none()
    }
}

impl Flash for ChipFlash {
    fn sectors(&self, _: Area) -> &'static [u32] {
        &SECTORS
    }

    fn read(&mut self, area: Area, offset: u32) -> u32 {
        let mut chip = self.0.borrow_mut();
        let word = chip.area(area)[offset as usize..].first_chunk().expect("it is within the area");
        u32::from_le_bytes(*word)
    }

    fn program(&mut self, area: Area, offset: u32, words: &[u32]) -> Result<(), FlashError> {
        let mut chip = self.0.borrow_mut();
        if chip.begin(0) {
            let cells = chip.area(area)[offset as usize..].iter_mut();
            let bytes = words.iter().flat_map(|word| word.to_le_bytes());
            cells.zip(bytes).for_each(|(cell, byte)| *cell &= byte);
        }
        Ok(())
    }

    fn erase(&mut self, area: Area, sector: usize) -> Result<(), FlashError> {
        let mut chip = self.0.borrow_mut();
        let us = chip.erase_us;
        if chip.begin(us) {
            chip.erases += 1;
            let start: u32 = SECTORS[..sector].iter().sum();
            chip.area(area)[start as usize..][..SECTORS[sector] as usize].fill(0xFF);
        }
        Ok(())
    }

    fn poll(&mut self) -> Option<Result<(), FlashError>> {
        let mut chip = self.0.borrow_mut();
        if chip.is_busy() { None } else { chip.end.take() }
    }
}
