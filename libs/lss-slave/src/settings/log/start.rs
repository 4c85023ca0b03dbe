//! The start of the log: it finds the newest record, makes it certain, and erases the bank without it.
//!
//! It searches both banks from the end. It takes the bank with the later certain record, and in it the last valid one:
//!
//! | it finds | it does |
//! |---|---|
//! | a certain record as the last one | takes it |
//! | a valid record as the last one, which is not certain | takes it, appends it again, as "erased" if the other bank is |
//! | a valid record, followed by something else | takes it, never writes into the rest, appends it again |
//! | a valid record whose parameters are damaged | takes it, appends it again without parameters |
//! | after any of these, a record without "erased", or anything in the other bank | appends it as "used", erases the other bank, appends it as "erased" |
//! | a record of another layout | takes the newest of this one, if there is one, and writes nothing |
//! | no valid record | erases both banks, writes a record without settings as "used" and "erased" |
//! | a flash that cannot be read, erased or written | continues with the settings found, or the defaults |

use core::{mem, ops::Range};

use super::{
    Error, Found, Log, Newest,
    place::{self, Layout, RESERVE, Space},
};
use crate::settings::record::{self, LEN, OtherBank, Record};

/// The result of the search in one bank.
pub struct Bank {
    range: Range<u32>,
    /// The last valid record.
    newest: Option<Newest>,
    /// The sequence number of the last certain record.
    certain: Option<u32>,
    /// There is a record of ours, though it may be damaged.
    is_ours: bool,
    /// There is a record of another layout, as far as the search has come.
    is_foreign: bool,
    /// The address from which the bank reads blank.
    blank_from: u32,
}

impl Bank {
    fn is_blank(&self) -> bool {
        self.blank_from == self.range.start
    }

    /// The newest record. A bank counts by a certain one, and in it the last valid one.
    pub fn counts(&self) -> Option<Newest> {
        self.newest.filter(|_| self.certain.is_some())
    }

    fn sequence(&self) -> Option<u32> {
        self.newest.map(|newest| newest.record.sequence)
    }

    /// The blank space, if its first place has this sequence number.
    fn space(&self, sequence: u32) -> Space {
        Space { range: self.blank_from..self.range.end, sequence, bank: self.range.start }
    }
}

/// Whether there is a sequence number, and it is later than `other`.
fn is_later(sequence: Option<u32>, other: Option<u32>) -> bool {
    match (sequence, other) {
        (Some(sequence), Some(other)) => record::is_newer(sequence, other),
        (sequence, _) => sequence.is_some(),
    }
}

impl<F: Layout, const STORED_LEN: usize> Log<F, STORED_LEN> {
    /// Finds the newest settings, makes them certain, and erases the bank without them if it is not erased.
    pub(super) fn find(&mut self) -> Result<Found, Error> {
        let (bank, other) = self.search();
        let is_other_later = is_later(other.sequence(), bank.sequence());
        let last = if is_other_later { other.sequence() } else { bank.sequence() };
        let sequence = last.map_or(0, |last| last.wrapping_add(1));
        self.space.sequence = sequence;
        let Some(newest) = bank.counts() else {
            return self.format(&bank, &other);
        };
        self.newest = newest;
        self.uncertain = Some(newest.record.sequence);
        // Before a record says that the other bank is erased, one is certain.
        self.counts = newest.record.other_is == OtherBank::Erased && !is_other_later;
        self.space = bank.space(sequence);
        let is_interrupted = bank.blank_from > newest.at.saturating_add(F::PLACE);
        let is_intact = newest.is_intact(&mut self.flash);
        if !is_intact {
            self.newest.record.parameters = None;
        }
        let is_certain = bank.certain == bank.sequence() && is_intact && !is_interrupted;
        let has_room = self.space.len::<F>() > RESERVE;
        let is_erased = newest.record.other_is == OtherBank::Erased && other.is_blank();
        if self.is_foreign([&bank, &other], !is_erased) {
            return Ok(Found::OtherLayout);
        }
        if is_erased && (is_certain || has_room) {
            self.other = other.space(self.sequence_after(&bank));
            if is_certain {
                self.uncertain = None;
            } else {
                self.append_copy(OtherBank::Erased)?;
            }
        } else {
            match self.append_copy(OtherBank::Used) {
                // As many starts as there are places for them have appended it.
                Ok(()) | Err(Error::Full) => {}
                outcome => outcome?,
            }
            self.erase(&other)?;
            if self.space.len::<F>() > RESERVE {
                self.append_copy(OtherBank::Erased)?;
            } else {
                self.move_on(&bank)?;
            }
        }
        Ok(match (is_intact, is_interrupted) {
            (false, _) => Found::ParametersDamaged,
            (true, true) => Found::Interrupted,
            (true, false) => Found::Complete,
        })
    }

    /// Begins a log where there is none.
    fn format(&mut self, bank: &Bank, other: &Bank) -> Result<Found, Error> {
        // If nothing can be read, the flash has failed, and what it holds must stay.
        let places = [bank, other].map(|bank| bank.range.clone().step_by(F::PLACE as usize));
        if !places.into_iter().flatten().any(|at| place::is_blank(&mut self.flash, at).is_ok()) {
            return Err(Error::Refused);
        }
        if self.is_foreign([bank, other], true) {
            return Ok(Found::OtherLayout);
        }
        self.erase(other)?;
        self.move_on(bank)?;
        Ok(match (bank.is_blank() && other.is_blank(), bank.is_ours || other.is_ours) {
            (true, _) => Found::Blank,
            (false, true) => Found::Damaged,
            (false, false) => Found::OtherData,
        })
    }

    /// Whether a bank holds a record of another layout; before an erase it is looked for everywhere.
    fn is_foreign(&mut self, banks: [&Bank; 2], is_erase: bool) -> bool {
        let len = self.bank_len().saturating_sub(LEN as u32 - 1);
        self.is_foreign = banks.into_iter().any(|bank| {
            let start = bank.range.start;
            let end = start.saturating_add(len).min(bank.blank_from);
            // Beside records of this layout are their parameters, which may hold anything.
            let (first, step) =
                if bank.is_ours { (F::FRAME, F::PLACE) } else { (0, F::FRAME as u32) };
            let mut all = (start.saturating_add(first as u32)..end).step_by(step as usize);
            let is_foreign = |at: u32| {
                let is_place = at.saturating_sub(start) % F::PLACE == F::FRAME as u32;
                let bytes = place::bytes(&mut self.flash, at);
                bytes.is_ok_and(|bytes| record::is_of_other_layout(&bytes, is_place))
            };
            bank.is_foreign || is_erase && all.any(is_foreign)
        });
        self.is_foreign
    }

    /// The bank that counts, and the other one.
    pub(super) fn search(&mut self) -> (Bank, Bank) {
        let bank_len = self.bank_len();
        let used = bank_len / F::PLACE * F::PLACE;
        let first = self.search_bank(0..used);
        let second = self.search_bank(bank_len..bank_len.saturating_add(used));
        let second_is_newer = match (first.certain, second.certain) {
            // Both are being formatted. The log goes to the bank without a record: an erase that is cut may make a record
            // certain, in a bank that cannot be written.
            (None, None) if first.newest.is_none() && second.newest.is_none() => first.is_blank(),
            (None, None) => is_later(second.sequence(), first.sequence()),
            (first, second) => is_later(second, first),
        };
        if second_is_newer { (second, first) } else { (first, second) }
    }

    fn search_bank(&mut self, range: Range<u32>) -> Bank {
        let start = range.start;
        let mut bank = Bank {
            range,
            newest: None,
            certain: None,
            is_ours: false,
            is_foreign: false,
            blank_from: start,
        };
        for at in bank.range.clone().step_by(F::PLACE as usize).rev() {
            if place::is_blank(&mut self.flash, at) == Ok(true) {
                continue;
            }
            if bank.is_blank() {
                bank.blank_from = at.saturating_add(F::PLACE);
            }
            let Ok(bytes) = place::content(&mut self.flash, at) else {
                continue;
            };
            bank.is_ours |= bytes.ends_with(&record::COMMIT);
            bank.is_foreign |= record::is_of_other_layout(&bytes, true);
            let Some(record) = Record::from_bytes(&bytes) else {
                continue;
            };
            if bank.newest.is_none() {
                bank.newest = Some(Newest { record, at, bank: start });
            }
            if place::is_certain(&mut self.flash, at, &bytes) == Ok(true) {
                bank.certain = Some(record.sequence);
                break;
            }
        }
        bank
    }

    /// The number of bytes that are erased with a bank.
    fn bank_len(&self) -> u32 {
        let erase_size = F::ERASE_SIZE as u32;
        self.flash.capacity() as u32 / 2 / erase_size * erase_size
    }

    /// A sequence number that is later than all in the bank with the newest record will be.
    fn sequence_after(&self, bank: &Bank) -> u32 {
        let places = bank.range.end.saturating_sub(bank.range.start) / F::PLACE;
        self.space.sequence.wrapping_add(places)
    }

    /// Erases the bank without the newest record.
    fn erase(&mut self, bank: &Bank) -> Result<(), Error> {
        let start = bank.range.start;
        let end = start.saturating_add(self.bank_len());
        self.flash.erase(start, end).map_err(|_| Error::Refused)?;
        let erased = self.search_bank(bank.range.clone());
        if erased.newest.is_none() {
            // Its blank places can be used.
            let sequence = self.sequence_after(bank);
            self.other = Space { range: bank.range.clone(), sequence, bank: start };
        }
        if erased.is_blank() { Ok(()) } else { Err(Error::NotBlank) }
    }

    /// Moves the newest record to the other bank, which is erased, and erases this one.
    fn move_on(&mut self, bank: &Bank) -> Result<(), Error> {
        self.space = mem::replace(&mut self.other, Space::NONE);
        self.append_copy(OtherBank::Used)?;
        self.erase(bank)?;
        self.append_copy(OtherBank::Erased)
    }

    /// Appends the newest record once more, which says this of the other bank, and is certain then.
    fn append_copy(&mut self, other_is: OtherBank) -> Result<(), Error> {
        let is_certain = self.append(self.newest.record.settings, None, other_is)?;
        if is_certain { Ok(()) } else { Err(Error::NotAsWritten) }
    }
}
