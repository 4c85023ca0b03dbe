//! The procedures of the loader, as steps that each start at most one operation of the flash.
//!
//! - **Restore**: both SAVED again, both KEPT void, UNDO, erase RUN, copy BACKUP, compare, BACK.
//! - **Save**, before an old program is erased: both SAVED void, erase BACKUP, copy RUN, compare, both SAVED.
//! - **Clear**: erase RUN. What an update has begun needs no second copy, only both SAVED again.

use core::mem;

use super::{Action, Cleared, Operation, Updater};
use crate::{
    Abort, Area, Flash, FlashError, ROW, Status, Verify,
    download::Phase,
    header::{Field, HEADER_LEN},
    journal::{self, Journal, KEPT, PAIRS, SAVED, SET, VOID, Word},
};

pub(super) const HEADER: u32 = HEADER_LEN as u32;
/// The words that one step reads at most, in each area.
pub(super) const CHUNK: u32 = 32;
const BLANK: u32 = u32::MAX;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Procedure {
    Restore,
    Save,
    Clear,
}

/// What comes next.
#[derive(Clone, Copy, Debug)]
pub(super) enum Step {
    /// Nothing, or the next word of a download.
    Idle,
    Saved {
        second: bool,
    },
    /// Goes on if a SAVED is set.
    Begin,
    Unsaved {
        second: bool,
    },
    Unkept {
        second: bool,
    },
    /// Compares RUN with BACKUP from this offset on, to choose a pair of UNDO and BACK.
    Choose(u32),
    /// Erases from this sector on.
    Erase(usize),
    /// Erases a sector of RUN if it is not blank from this offset on.
    EraseUsed {
        sector: usize,
        offset: u32,
    },
    /// Copies a program from this offset on, and its header behind it; of a download only the header.
    Copy(u32),
    /// Compares the copy with the program from this offset on.
    Compare(u32),
    Restored,
    Leave,
    /// The CRC of a download, from this word on, after which the CRC is this.
    Check {
        word: u32,
        crc: u32,
    },
    /// Waits for its SHA-256.
    Hashing,
    /// The program is complete.
    Done,
}

impl<F: Flash, V: Verify, const WORDS: usize> Updater<F, V, WORDS> {
    /// 1F51h = 3.
    pub(super) fn clear(&mut self) -> Result<(), Abort> {
        self.reset = super::Reset::No;
        self.abort();
        self.status = Status::Ok;
        if self.may_download() {
            return Ok(());
        }
        if V::IS_SIGNED && !mem::take(&mut self.has_proof) {
            self.status = Status::Refused(Field::Signature);
            return Err(Abort::DeviceState);
        }
        self.cleared = Cleared::Soon;
        if !matches!(self.step, Step::Idle) {
            // A restore, or the mark of a new program: it has to be undone.
            self.clears_then = true;
            return Ok(());
        }
        self.begin_clear();
        Ok(())
    }

    fn begin_clear(&mut self) {
        let is_new = self.journal.is_loaded() || self.journal.is_undone();
        let has_backup = self.journal.is_saved() && self.backup.is_some();
        (self.procedure, self.step) = if has_backup && self.journal.is_pending() && !is_new {
            (Procedure::Clear, Step::Saved { second: false })
        } else if has_backup && (self.journal.is_pending() || self.run.is_none()) {
            self.clears_then = true;
            (Procedure::Restore, Step::Saved { second: false })
        } else if self.run.is_some() {
            self.backup = None;
            (Procedure::Save, Step::Unsaved { second: false })
        } else if self.backup.is_some() {
            // Nothing else is left: no SAVED is taken back.
            (Procedure::Clear, Step::Erase(0))
        } else {
            (Procedure::Clear, Step::Unsaved { second: false })
        };
    }

    /// Does the next step. The flash is ready.
    pub(super) fn step(&mut self) -> Result<Option<Action>, FlashError> {
        match self.step {
            Step::Idle if self.clears_then => {
                self.clears_then = false;
                self.begin_clear();
            }
            Step::Idle => self.write_download()?,
            Step::Saved { second } => {
                let is_needed = self.procedure == Procedure::Save;
                self.mark(one_of(SAVED, second), SET, is_needed)?;
                self.step = if second { Step::Begin } else { Step::Saved { second: true } };
            }
            Step::Begin => self.begin()?,
            Step::Unsaved { second } => {
                self.mark(one_of(SAVED, second), VOID, true)?;
                self.step = match self.procedure {
                    _ if !second => Step::Unsaved { second: true },
                    Procedure::Restore => Step::Leave,
                    Procedure::Save | Procedure::Clear => Step::Erase(0),
                };
            }
            Step::Unkept { second } => {
                self.mark(one_of(KEPT, second), VOID, true)?;
                self.step = if second { Step::Choose(0) } else { Step::Unkept { second: true } };
            }
            Step::Choose(offset) => match self.compare(offset) {
                Some(Ok(next)) => self.step = Step::Choose(next),
                outcome => {
                    self.choose(outcome.is_none())?;
                    self.step = Step::Erase(0);
                }
            },
            Step::Erase(sector) => self.erase(sector)?,
            Step::EraseUsed { sector, offset } => self.erase_used(sector, offset)?,
            Step::Copy(offset) => self.copy(offset)?,
            Step::Compare(offset) => match self.compare(offset) {
                Some(next) => self.step = Step::Compare(next?),
                None => self.compared()?,
            },
            Step::Restored => {
                self.run = self.backup;
                self.step = if self.clears_then { Step::Idle } else { Step::Leave };
            }
            Step::Leave => {
                self.step = Step::Idle;
                return Ok(Some(Action::Reset));
            }
            Step::Check { word, crc } => return self.check(word, crc),
            Step::Hashing => {}
            Step::Done => {
                self.run = self.download.header;
                self.step = Step::Idle;
                self.cleared = Cleared::No;
                let is_waiting = self.download.phase == Phase::Ended;
                self.download.phase = Phase::None;
                return Ok(is_waiting.then_some(Action::Answer(Ok(()))));
            }
        }
        Ok(None)
    }

    fn begin(&mut self) -> Result<(), FlashError> {
        match self.procedure {
            Procedure::Restore if self.journal.is_saved() => {
                self.step = Step::Unkept { second: false };
            }
            Procedure::Save | Procedure::Clear if self.journal.is_saved() => {
                self.procedure = Procedure::Clear;
                self.step = Step::Erase(0);
            }
            _ if self.run.is_none() => return Err(FlashError::Failed),
            // A clear was cut while it voided them, and RUN is as it was.
            Procedure::Restore if !self.clears_then => self.step = Step::Unsaved { second: false },
            _ => {
                self.clears_then = false;
                self.begin_clear();
            }
        }
        Ok(())
    }

    pub(super) fn mark(
        &mut self,
        word: Word,
        value: u32,
        is_needed: bool,
    ) -> Result<(), FlashError> {
        self.row[0] = value;
        self.flash.program(Area::Backup, word.offset(), &[value])?;
        self.operation = Some(Operation::Mark { word, is_needed });
        Ok(())
    }

    /// Programs the first words of the row.
    pub(super) fn program(&mut self, area: Area, offset: u32, len: u32) -> Result<(), FlashError> {
        let words = self.row.get(..len as usize).unwrap_or_default();
        self.flash.program(area, offset, words)?;
        self.operation = Some(Operation::Program { area, offset, len });
        Ok(())
    }

    /// Chooses UNDO and BACK of this restore. RUN that is equal may come from one that has ended, although its BACK is not
    /// set: at a later start it may be.
    fn choose(&mut self, is_equal: bool) -> Result<(), FlashError> {
        let last = PAIRS.iter().rposition(|(undo, _)| self.journal.is_set(*undo));
        let number = match last {
            None => 0,
            Some(last) if is_equal => last.saturating_add(1).min(PAIRS.len() - 1),
            Some(last) => last,
        };
        let Some((undo, back)) = PAIRS.get(number) else { return Ok(()) };
        self.back = *back;
        if last == Some(number) && !is_equal { Ok(()) } else { self.mark(*undo, SET, true) }
    }

    /// From where and to where a program is copied.
    fn direction(&self) -> (Area, Area) {
        match self.procedure {
            Procedure::Save => (Area::Run, Area::Backup),
            Procedure::Restore | Procedure::Clear => (Area::Backup, Area::Run),
        }
    }

    /// How many words from this offset on belong to the program that is copied, or to its header before the journal:
    /// `most` of them.
    fn words(&self, offset: u32, most: u32) -> u32 {
        let header = if self.procedure == Procedure::Save { &self.run } else { &self.backup };
        let end = match offset {
            ..journal::OFFSET => journal::OFFSET,
            journal::OFFSET..HEADER => offset,
            _ => header.as_ref().map_or(0, |header| header.length).saturating_add(HEADER),
        };
        most.min(end.saturating_sub(offset) / 4)
    }

    fn copy(&mut self, offset: u32) -> Result<(), FlashError> {
        let (from, to) = self.direction();
        let len = self.words(offset, ROW as u32);
        self.step = match len {
            0 if offset >= HEADER => Step::Copy(0),
            0 if self.procedure == Procedure::Clear => return self.complete(),
            0 => Step::Compare(0),
            len => {
                let row = self
                    .row
                    .iter_mut()
                    .zip(0..len)
                    .map(|(word, i)| (word, offset.wrapping_add(4 * i)));
                if self.procedure == Procedure::Clear {
                    row.for_each(|(word, offset)| *word = self.download.header_word(offset));
                } else {
                    row.for_each(|(word, offset)| *word = self.flash.read(from, offset));
                }
                self.program(to, offset, len)?;
                Step::Copy(offset.wrapping_add(4 * len))
            }
        };
        Ok(())
    }

    /// Compares the next words of the two areas; returns the offset of the word after them, an error for a difference,
    /// and `None` after the last one.
    fn compare(&mut self, offset: u32) -> Option<Result<u32, FlashError>> {
        let len = self.words(offset, CHUNK);
        if len == 0 {
            return (offset < HEADER).then_some(Ok(HEADER));
        }
        let is_equal = (0..len).map(|i| offset.wrapping_add(4 * i)).all(|offset| {
            self.flash.read(Area::Run, offset) == self.flash.read(Area::Backup, offset)
        });
        Some(if is_equal { Ok(offset.wrapping_add(4 * len)) } else { Err(FlashError::Failed) })
    }

    fn compared(&mut self) -> Result<(), FlashError> {
        match self.procedure {
            Procedure::Restore => {
                self.mark(self.back, SET, true)?;
                self.step = Step::Restored;
            }
            Procedure::Save | Procedure::Clear => {
                self.backup = self.run;
                self.step = Step::Saved { second: false };
            }
        }
        Ok(())
    }

    /// Erases the sectors that need it: of BACKUP those for the copy; of RUN all, but after those of a valid program only
    /// what is not blank. Without a valid program an erase may have been interrupted, and blank is not certain.
    fn erase(&mut self, sector: usize) -> Result<(), FlashError> {
        let (_, area) = self.direction();
        let end = self.run.map(|header| header.length.saturating_add(HEADER));
        if sector == 0 {
            match area {
                Area::Run => (self.run, self.run_end) = (None, end),
                Area::Backup => (self.journal, self.run_end) = (Journal::default(), end),
            }
        }
        let Some((start, _)) = self.sector(area, sector) else {
            self.erased();
            return Ok(());
        };
        if sector == 0 || self.run_end.is_none_or(|end| start < end) {
            self.erase_sector(area, sector)
        } else if area == Area::Backup {
            self.erased();
            Ok(())
        } else {
            self.step = Step::EraseUsed { sector, offset: start };
            Ok(())
        }
    }

    fn erased(&mut self) {
        if self.procedure == Procedure::Clear {
            self.cleared = Cleared::Yes;
            self.step = Step::Idle;
        } else {
            self.step = Step::Copy(HEADER);
        }
    }

    fn erase_used(&mut self, sector: usize, offset: u32) -> Result<(), FlashError> {
        let next = offset.wrapping_add(4 * CHUNK);
        match self.sector(Area::Run, sector) {
            Some((_, end)) if offset < end => {
                let mut offsets = (offset..next.min(end)).step_by(4);
                if offsets.any(|offset| self.flash.read(Area::Run, offset) != BLANK) {
                    return self.erase_sector(Area::Run, sector);
                }
                self.step = Step::EraseUsed { sector, offset: next };
            }
            _ => self.step = Step::Erase(sector.wrapping_add(1)),
        }
        Ok(())
    }

    fn erase_sector(&mut self, area: Area, sector: usize) -> Result<(), FlashError> {
        self.flash.erase(area, sector)?;
        self.operation = Some(Operation::Erase);
        self.step = Step::Erase(sector.wrapping_add(1));
        Ok(())
    }

    /// Where a sector begins and ends.
    fn sector(&self, area: Area, sector: usize) -> Option<(u32, u32)> {
        let sectors = self.flash.sectors(area);
        let len = sectors.get(sector)?;
        let start = sectors.iter().take(sector).fold(0u32, |sum, len| sum.wrapping_add(*len));
        Some((start, start.wrapping_add(*len)))
    }
}

fn one_of([first, second]: [Word; 2], is_second: bool) -> Word {
    if is_second { second } else { first }
}
