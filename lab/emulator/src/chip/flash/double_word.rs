//! Programming of an STM32G4: double words with ECC, once after each erase (RM0440 3.3.7).

use super::{CR_LOCK, CR_MER, CR_PG, CR_SER, Flash, Kind, Operation, SR_PGSERR, SR_WRPERR};
use crate::{
    Time,
    chip::{Problem, Width},
};

const SR_PROGERR: u32 = 1 << 3;
const SR_PGAERR: u32 = 1 << 5;
const SR_SIZERR: u32 = 1 << 6;
const ERRORS: u32 = SR_PROGERR | SR_WRPERR | SR_PGAERR | SR_SIZERR | SR_PGSERR;

impl Flash {
    /// A store of the CPU: the first word of a double word waits for the second, which programs both.
    pub(super) fn program_double_word(&mut self, offset: u32, width: Width, value: u32, now: Time) {
        let first = self.first_word.take();
        let is_enabled = self.cr & (CR_PG | CR_LOCK | CR_SER | CR_MER) == CR_PG;
        let error = if self.fails(self.refused_programs) {
            self.refused_programs -= 1;
            SR_PGSERR
        } else if !is_enabled || self.sr & ERRORS != 0 {
            SR_PGSERR
        } else if width != Width::Word {
            SR_SIZERR
        } else {
            match first {
                None if offset.is_multiple_of(8) => {
                    self.first_word = Some((offset, value));
                    return;
                }
                Some((start, low)) if offset == start + 4 => {
                    self.program_both(start, u64::from(value) << 32 | u64::from(low), now)
                }
                _ => SR_PGAERR,
            }
        };
        self.sr |= error;
    }

    /// Returns the error, or 0.
    fn program_both(&mut self, start: u32, value: u64, now: Time) -> u32 {
        let range = start as usize..start as usize + 8;
        let before = self.array.bytes()[range.clone()].to_vec();
        if value != 0 && before != [0xFF; 8] {
            return SR_PROGERR;
        }
        let mut programmed = value;
        if self.fails(self.failing_programs) {
            self.failing_programs -= 1;
            // The lowest bit to be cleared stays set.
            programmed |= !value & value.wrapping_add(1);
        }
        self.array.program(start, &programmed.to_le_bytes());
        let end = now + self.timing.program_double_word();
        self.begin(Operation { end, range, before, kind: Kind::Program }, now);
        0
    }

    /// The write of a word to flash that is not erased is an error of the program.
    pub(super) fn misuse_of_double_words(&self) -> Result<(), Problem> {
        match self.sr & SR_PROGERR {
            0 => Ok(()),
            _ => Err(Problem::Misuse("a double word is programmed again without an erase")),
        }
    }
}
