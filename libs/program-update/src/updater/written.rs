//! A download on its way from the RAM into RUN: its words, the check of the whole, its header, and LOADED.

use super::{
    Action, Cleared, Updater,
    steps::{CHUNK, HEADER, Step},
};
use crate::{
    Area, Flash, FlashError, Status, Verify, crc,
    download::{Phase, Proof},
    header::Field,
    journal::{LOADED, SET},
};

impl<F: Flash, V: Verify, const WORDS: usize> Updater<F, V, WORDS> {
    /// Writes the next words of a download; after the last one its check begins.
    pub(super) fn write_download(&mut self) -> Result<(), FlashError> {
        let is_proven = !V::IS_SIGNED || self.download.proof == Proof::Given;
        if !(is_proven && matches!(self.cleared, Cleared::Yes | Cleared::Used)) {
            return Ok(());
        }
        let offset = HEADER.wrapping_add(self.download.taken.wrapping_mul(4));
        let len = self.download.take_row(&mut self.row);
        if len > 0 {
            self.cleared = Cleared::Used;
            self.program(Area::Run, offset, len)?;
        } else if self.download.phase == Phase::Ended {
            self.step = Step::Check { word: 0, crc: crc::BEGIN };
        }
        Ok(())
    }

    pub(super) fn check(&mut self, word: u32, crc: u32) -> Result<Option<Action>, FlashError> {
        let Some(header) = self.download.header else { return Ok(None) };
        let left = (header.length / 4).saturating_sub(word);
        let words = left.min(CHUNK);
        let offset = HEADER.wrapping_add(word.wrapping_mul(4));
        let crc = self.flash.crc(Area::Run, offset, words, crc);
        if words < left {
            self.step = Step::Check { word: word.wrapping_add(words), crc };
            return Ok(None);
        }
        let stack_pointer = self.flash.read(Area::Run, HEADER);
        let reset = self.flash.read(Area::Run, HEADER + 4);
        let outcome = if !crc != header.crc {
            Err(Status::Damaged(Field::Crc))
        } else {
            header.check_vectors(&self.expected, stack_pointer, reset)
        };
        Ok(match outcome {
            Ok(()) if V::IS_SIGNED => {
                self.step = Step::Hashing;
                Some(Action::Hash { words: header.length / 4 })
            }
            Ok(()) => {
                self.step = Step::Copy(0);
                None
            }
            Err(status) => Some(self.refuse_program(status)),
        })
    }

    /// Marks the program as complete. Without a program before it, there is no trial.
    pub(super) fn complete(&mut self) -> Result<(), FlashError> {
        if self.journal.is_saved() {
            self.mark(LOADED, SET, true)?;
        }
        self.step = Step::Done;
        Ok(())
    }
}
