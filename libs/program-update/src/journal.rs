//! The journal of an update: words of BACKUP that say which of the two programs counts.
//!
//! A word is *set* if it reads [`SET`], and *void* if it reads 0. A word whose programming was interrupted may read set
//! at one start and not at the next. So what decides is in two words, a start programs again what it reads set, and
//! each word is read back.
//!
//! - SAVED, twice: BACKUP holds the program that was confirmed last. Voided before BACKUP is erased.
//! - LOADED: RUN holds a complete new program.
//! - TRY, three times: a start of it.
//! - KEPT, twice: it was confirmed.
//! - UNDO and BACK, three pairs: a restore has begun, and has ended. A later UNDO takes back an earlier BACK: only an
//!   attempt that finds RUN restored, and BACK not set, needs another pair.
//!
//! The update is *pending* if a SAVED is set, no KEPT, and no BACK without a later UNDO.

use crate::{Area, Flash, FlashError, State, flash};

/// A word that is set.
pub const SET: u32 = 0x5AA5_3CC3;
/// A word that was taken back.
pub const VOID: u32 = 0;
/// The offset of the first word in BACKUP.
pub const OFFSET: u32 = 0x1C0;
/// The number of words.
pub const WORDS: u32 = 14;

/// A word of the journal, by its number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Word(u32);

pub(crate) const SAVED: [Word; 2] = [Word(0), Word(1)];
pub(crate) const LOADED: Word = Word(2);
pub(crate) const TRY: [Word; 3] = [Word(3), Word(4), Word(5)];
pub(crate) const KEPT: [Word; 2] = [Word(6), Word(7)];
/// UNDO and BACK.
pub(crate) const PAIRS: [(Word, Word); 3] =
    [(Word(8), Word(9)), (Word(10), Word(11)), (Word(12), Word(13))];

impl Word {
    /// Its offset in BACKUP.
    pub(crate) const fn offset(self) -> u32 {
        OFFSET.wrapping_add(self.0.wrapping_mul(4))
    }

    const fn bit(self) -> u16 {
        1u16.wrapping_shl(self.0)
    }
}

/// Which words are set.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Journal {
    set: u16,
}

impl Journal {
    /// Reads the journal.
    pub fn read<F: Flash>(flash: &mut F) -> Self {
        let set = (0..WORDS).fold(0, |set, i| {
            let is_set = flash.read(Area::Backup, Word(i).offset()) == SET;
            if is_set { set | Word(i).bit() } else { set }
        });
        Self { set }
    }

    /// Reads the journal and makes it firm: programs again each word that is set, and both KEPT if one of them is. It
    /// waits for each word. An operation that fails changes nothing in what was read.
    pub fn open<F: Flash>(flash: &mut F) -> Self {
        let mut journal = Self::read(flash);
        for i in 0..WORDS {
            if journal.is_set(Word(i)) {
                let _ = flash::write(flash, Area::Backup, Word(i).offset(), SET);
            }
        }
        if journal.is_saved() && journal.is_kept() && !journal.is_restored() {
            for word in KEPT {
                if !journal.is_set(word) {
                    let _ = journal.write(flash, word, SET);
                }
            }
        }
        journal
    }

    /// Programs a word, waits, and reads it back.
    pub(crate) fn write<F: Flash>(
        &mut self,
        flash: &mut F,
        word: Word,
        value: u32,
    ) -> Result<(), FlashError> {
        flash::write(flash, Area::Backup, word.offset(), value)?;
        self.note(word, value);
        Ok(())
    }

    /// Notes what was programmed.
    pub(crate) fn note(&mut self, word: Word, value: u32) {
        if value == SET { self.set |= word.bit() } else { self.set &= !word.bit() }
    }

    pub(crate) fn is_set(self, word: Word) -> bool {
        self.set & word.bit() != 0
    }

    /// BACKUP holds the program that was confirmed last.
    pub fn is_saved(self) -> bool {
        SAVED.into_iter().any(|word| self.is_set(word))
    }

    /// RUN holds a complete new program.
    pub fn is_loaded(self) -> bool {
        self.is_set(LOADED)
    }

    /// The new program was confirmed.
    pub fn is_kept(self) -> bool {
        KEPT.into_iter().any(|word| self.is_set(word))
    }

    /// A restore has begun.
    pub fn is_undone(self) -> bool {
        PAIRS.into_iter().any(|(undo, _)| self.is_set(undo))
    }

    /// The last restore has ended.
    pub fn is_restored(self) -> bool {
        let last =
            PAIRS.into_iter().rev().find(|(undo, back)| self.is_set(*undo) || self.is_set(*back));
        last.is_some_and(|(_, back)| self.is_set(back))
    }

    /// The program in RUN is not the one that was confirmed last, or may not be.
    pub fn is_pending(self) -> bool {
        self.is_saved() && !self.is_kept() && !self.is_restored()
    }

    /// The starts of the program on trial.
    pub fn tries(self) -> u8 {
        TRY.into_iter().fold(0, |tries: u8, word| tries.saturating_add(self.is_set(word).into()))
    }

    /// Where the update is.
    pub fn state(self) -> State {
        if !self.is_saved() {
            State::None
        } else if self.is_restored() {
            State::Restored
        } else if self.is_kept() {
            State::Kept
        } else if self.is_loaded() && !self.is_undone() {
            State::Trial
        } else {
            State::UnderWay
        }
    }
}
