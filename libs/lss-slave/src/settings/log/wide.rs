//! The log in flash with wide program units: of 8, 16 or 32 bytes, with an error-correcting code.
//!
//! Such a unit is written once after an erase. If its writing was interrupted it may read as blank, as written, as
//! anything, or not at all, and differently each time. So may each unit of a bank whose erase was interrupted, and
//! whatever such a bank reads must not count: what makes it count lies in the other bank, written before the erase.
//!
//! # A place
//! - A unit of zeros begins it. It is the only unit that may have been torn although it reads blank. If it is written
//!   once more, then with the same value; if the flash refuses that, the log passes over the place.
//! - The 32 bytes of a record or of a part of the parameters, as in other flash.
//! - After a record is read back, the commit unit, which repeats its CRC and commit word. A record with a commit unit
//!   is certain: the 32 bytes read the same at every start.
//!
//! # Rules
//! - A record has a greater sequence number than all that its writer could read in both banks. The bank with the later
//!   certain record counts, and in it the last valid record.
//! - A record says how the [other bank](OtherBank) is. It says "erased" only if an erase was completed, and this holds
//!   until a later record in the same bank says otherwise.
//! - Before an erase, the newest record is appended twice by the same start. The first copy, which says "used", must be
//!   certain, and the second, which says "doomed", tells that to the starts after it. So whatever a half-erased bank
//!   reads, a certain record in this bank is later than all that could ever be certain in the other one. Records that
//!   never had a commit unit do not show one.
//! - Only starts use the last [places](record::RESERVE) of a bank. If they are used up, or only these are left after an
//!   erase, the log moves to the other bank.

use core::ops::Range;

use embedded_storage::nor_flash::NorFlash;

use super::{Error, Found, Layout, Log, Newest, Space};
use crate::{
    bytes::copy,
    settings::{
        Settings,
        record::{self, OtherBank, Record},
    },
};

/// The greatest program unit.
const MOST: usize = 32;
/// The number of places in a row that are passed over.
const MOST_TORN: u32 = 8;

/// The result of the search in one bank.
struct Bank {
    range: Range<u32>,
    /// The last valid record, and what it says.
    newest: Option<Newest>,
    other_is: OtherBank,
    /// The sequence number of the last certain record.
    certain: Option<u32>,
    /// The address from which no place was begun.
    blank_from: u32,
}

impl Bank {
    fn is_blank(&self) -> bool {
        self.blank_from == self.range.start
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

/// Reads whole units, and once more if that fails: if it fails again, a unit is torn.
pub(super) fn read<F: NorFlash>(flash: &mut F, at: u32, to: &mut [u8]) -> Result<(), Error> {
    flash.read(at, to).or_else(|_| flash.read(at, to)).map_err(|_| Error::Refused)
}

/// Whether the unit has not been written, as far as can be read.
fn is_unit_blank<F: NorFlash>(flash: &mut F, at: u32) -> Result<bool, Error> {
    let mut unit = [0; MOST];
    let unit = unit.get_mut(..F::WRITE_SIZE).unwrap_or_default();
    read(flash, at, unit)?;
    Ok(unit.iter().all(|byte| *byte == 0xFF))
}

/// The commit unit of a record: its CRC and commit word.
fn commit_unit(bytes: &[u8; record::LEN as usize]) -> [u8; MOST] {
    let mut unit = [0xFF; MOST];
    copy(bytes, record::CRC_AT, &mut unit);
    unit
}

fn commit_unit_at<F: NorFlash>(at: u32) -> u32 {
    at.saturating_add(F::PLACE).saturating_sub(F::WRITE_SIZE as u32)
}

/// Whether the record in these bytes, at this place, has its commit unit.
fn is_certain<F: NorFlash>(flash: &mut F, at: u32, bytes: &[u8; record::LEN as usize]) -> bool {
    let mut unit = [0; MOST];
    let unit = unit.get_mut(..F::WRITE_SIZE).unwrap_or_default();
    read(flash, commit_unit_at::<F>(at), unit).is_ok() && commit_unit(bytes).starts_with(unit)
}

impl<F: NorFlash, const STORED_LEN: usize> Log<F, STORED_LEN> {
    /// Finds the newest settings, makes them certain, and erases the bank without them if it is not erased.
    pub(super) fn find_wide(&mut self) -> Result<Found, Error> {
        let found = self.find_and_tidy();
        for space in [&mut self.space, &mut self.other] {
            space.range.end =
                space.range.end.saturating_sub(record::RESERVE.saturating_mul(F::PLACE));
        }
        found
    }

    fn find_and_tidy(&mut self) -> Result<Found, Error> {
        let bank_len = self.bank_len();
        let used = bank_len / F::PLACE * F::PLACE;
        let first = self.search_wide(0..used);
        let second = self.search_wide(bank_len..bank_len.saturating_add(used));
        let is_blank = first.is_blank() && second.is_blank();
        let second_is_newer = match (first.certain, second.certain) {
            // While they are formatted. It continues in the other one.
            (None, None) if first.newest.is_none() && second.newest.is_none() => first.is_blank(),
            (None, None) => is_later(second.sequence(), first.sequence()),
            (first, second) => is_later(second, first),
        };
        let (bank, other) = if second_is_newer { (second, first) } else { (first, second) };
        let is_other_later = is_later(other.sequence(), bank.sequence());
        let last = if is_other_later { other.sequence() } else { bank.sequence() };
        let sequence = last.map_or(0, |last| last.wrapping_add(1));
        self.space.sequence = sequence;
        let Some(newest) = bank.newest.filter(|_| bank.certain.is_some()) else {
            // If nothing can be read, the flash has failed, and what it holds must stay.
            let places = [&bank, &other].map(|bank| bank.range.clone().step_by(F::PLACE as usize));
            if !places.into_iter().flatten().any(|at| is_unit_blank(&mut self.flash, at).is_ok()) {
                return Err(Error::Refused);
            }
            self.erase_wide(&other)?;
            self.move_on(&bank)?;
            return Ok(if is_blank { Found::Blank } else { Found::Damaged });
        };
        self.newest = newest;
        self.space = bank.space(sequence);
        let is_interrupted = bank.blank_from > newest.at.saturating_add(F::PLACE);
        let is_intact = newest.is_intact(&mut self.flash)?;
        if !is_intact {
            self.newest.record.parameters = None;
        }
        let is_certain = bank.certain == bank.sequence() && is_intact && !is_interrupted;
        if bank.other_is == OtherBank::Erased && other.is_blank() {
            self.other = other.space(self.sequence_after(&bank));
            self.other_is = OtherBank::Erased;
            if !is_certain {
                self.put(newest.record.settings, None)?;
            }
        } else {
            let is_doomed = is_certain && bank.other_is == OtherBank::Doomed && !is_other_later;
            if !is_doomed {
                for other_is in [OtherBank::Used, OtherBank::Doomed] {
                    match self.append_copy(other_is) {
                        Ok(()) | Err(Error::Full) => {}
                        outcome => outcome?,
                    }
                }
            }
            self.erase_wide(&other)?;
            if self.space.len::<F>() > record::RESERVE {
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

    fn search_wide(&mut self, range: Range<u32>) -> Bank {
        let mut bank = Bank {
            newest: None,
            other_is: OtherBank::Used,
            certain: None,
            blank_from: range.start,
            range,
        };
        let start = bank.range.start;
        for at in bank.range.clone().step_by(F::PLACE as usize).rev() {
            if is_unit_blank(&mut self.flash, at) == Ok(true) {
                continue;
            }
            if bank.is_blank() {
                bank.blank_from = at.saturating_add(F::PLACE);
            }
            let Ok(bytes) = super::read(&mut self.flash, at) else {
                continue;
            };
            let record = Record::from_bytes(&bytes).filter(|_| bytes.ends_with(&record::COMMIT));
            let Some(record) = record else {
                continue;
            };
            if bank.newest.is_none() {
                bank.newest = Some(Newest { record, at, bank: start });
                bank.other_is = OtherBank::of_record(&bytes);
            }
            if is_certain(&mut self.flash, at, &bytes) {
                bank.certain = Some(record.sequence);
                break;
            }
        }
        bank
    }

    /// A sequence number that is later than all in the bank with the newest record will be.
    fn sequence_after(&self, bank: &Bank) -> u32 {
        let places = bank.range.end.saturating_sub(bank.range.start) / F::PLACE;
        self.space.sequence.wrapping_add(places)
    }

    /// Erases the bank without the newest record.
    fn erase_wide(&mut self, bank: &Bank) -> Result<(), Error> {
        let start = bank.range.start;
        let end = start.saturating_add(self.bank_len());
        self.flash.erase(start, end).map_err(|_| Error::Refused)?;
        if self.search_wide(bank.range.clone()).newest.is_some() {
            return Err(Error::NotBlank);
        }
        let sequence = self.sequence_after(bank);
        self.other = Space { range: bank.range.clone(), sequence, bank: start };
        Ok(())
    }

    /// Moves the newest record to the other bank, which is erased, and erases this one.
    fn move_on(&mut self, bank: &Bank) -> Result<(), Error> {
        self.put_in_other(self.newest.record.settings, None)?;
        self.append_copy(OtherBank::Doomed)?;
        self.erase_wide(bank)?;
        self.append_copy(OtherBank::Erased)
    }

    /// Appends the newest record once more, which says this of the other bank.
    fn append_copy(&mut self, other_is: OtherBank) -> Result<(), Error> {
        self.other_is = other_is;
        self.append(self.newest.record.settings, None, false)
    }

    /// Appends a record behind places that turned out to be torn.
    pub(super) fn pass_torn_places(
        &mut self,
        mut outcome: Result<(), Error>,
        settings: Option<Settings>,
        new: Option<&[u8]>,
        in_other: bool,
    ) -> Result<(), Error> {
        for _ in 0..MOST_TORN {
            if outcome != Err(Error::NotBlank) {
                break;
            }
            outcome = self.append_once(settings, new, in_other);
        }
        outcome
    }

    /// Writes the first unit of a place.
    pub(super) fn begin_wide(&mut self, at: u32) -> Result<(), Error> {
        let zeros = [0; MOST];
        let unit = zeros.get(..F::WRITE_SIZE).unwrap_or_default();
        let was_blank = is_unit_blank(&mut self.flash, at) == Ok(true);
        let is_begun = was_blank && self.flash.write(at, unit).is_ok();
        if is_begun && is_unit_blank(&mut self.flash, at) == Ok(false) {
            return Ok(());
        }
        Err(Error::NotBlank)
    }

    /// Writes 32 bytes to a place that is begun.
    pub(super) fn write_once(
        &mut self,
        at: u32,
        bytes: &[u8; record::LEN as usize],
    ) -> Result<(), Error> {
        let content_at = at.saturating_add(F::WRITE_SIZE as u32);
        self.flash.write(content_at, bytes).map_err(|_| Error::Refused)?;
        if super::read(&mut self.flash, at)? == *bytes { Ok(()) } else { Err(Error::NotAsWritten) }
    }

    /// Writes a record to a place that is begun.
    pub(super) fn write_wide(
        &mut self,
        at: u32,
        record: Record,
        in_other: bool,
    ) -> Result<(), Error> {
        if in_other {
            self.other_is = OtherBank::Used;
        }
        let bytes = self.other_is.add_to(record.to_bytes());
        // A unit that the flash could not write may read as written later.
        self.is_doubtful = true;
        self.write_once(at, &bytes)?;
        let unit = commit_unit(&bytes);
        let unit = unit.get(..F::WRITE_SIZE).unwrap_or_default();
        // The read-back decides, as at the next open.
        let _ = self.flash.write(commit_unit_at::<F>(at), unit);
        if !is_certain(&mut self.flash, at, &bytes) {
            return Err(Error::NotAsWritten);
        }
        self.is_doubtful = false;
        Ok(())
    }
}
