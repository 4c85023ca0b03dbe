//! The settings log: records appended to one of two banks of flash. The newest valid record holds the settings.
//!
//! # The promise
//! Whenever the power fails, the next [`Log::open`] finds the settings of the last [`Log::store`] that returned `Ok`,
//! or those of a later one that did not return; never older ones, never a mix. The result of an `open` holds until the
//! next store. Five rules ensure this:
//! - A record is valid only with its CRC and with its commit word, which is written after the rest was read back.
//! - A word whose write was interrupted by a power cut may read differently at each start. `open` therefore rewrites
//!   the commit word of the record that it accepts, and also the record itself if later content may turn out valid.
//! - Space is written once after each erase, and only if it reads blank, never where an interrupted store has written.
//! - A bank is erased only while the other one holds the newest record, and by `open`, never by `store`: an erase stops
//!   the CPU for up to 800 ms, which a node on the bus cannot afford.
//! - Records are appended only to the bank with the newest record, which proves that its erase was completed.

use core::{error, fmt, mem, ops::Range};

use embedded_storage::nor_flash::NorFlash;

use super::{
    Settings,
    record::{self, Record},
};

/// The result of [`Log::open`], for the device's log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Found {
    /// The newest record is valid, with nothing after it.
    Complete,
    /// The newest record is valid, with the remains of an interrupted store after it.
    Interrupted,
    /// The flash was blank, as in a new device; it is now formatted.
    Blank,
    /// No record was valid, but the flash was not blank; it is now formatted and the device's defaults apply.
    Damaged,
    /// The flash could not be read, erased or written. The settings that were found apply, but storing may fail.
    MediumFailed(Error),
}

/// The settings log, on a flash that holds nothing else.
///
/// The flash is used as two banks of equal size, each a multiple of the erase size; a bank of 16 KB has room for 512
/// records. `open` moves to the other bank when less than a quarter of the current one is left.
pub struct Log<F> {
    flash: F,
    newest: Record,
    /// The sequence number of the last record written or attempted.
    sequence: u32,
    /// The last record was written but could not be read back. A later `open` may find it valid.
    is_doubtful: bool,
    /// The blank space in the bank with the newest record.
    space: Range<u32>,
}

/// A failure of the flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Error {
    /// The flash reported an error, such as write protection.
    Refused,
    /// Space that was not written after its erase does not read blank.
    NotBlank,
    /// A record reads back differently than it was written.
    NotAsWritten,
    /// The bank is full until the next [`Log::open`].
    Full,
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Refused => "the flash reports an error",
            Self::NotBlank => "the flash is not blank where it was erased",
            Self::NotAsWritten => "the flash reads back otherwise than written",
            Self::Full => "the flash is full until the next power-on",
        })
    }
}

impl error::Error for Error {}

#[cfg(feature = "defmt")]
impl defmt::Format for Error {
    fn format(&self, f: defmt::Formatter<'_>) {
        match self {
            Self::Refused => defmt::write!(f, "the flash reports an error"),
            Self::NotBlank => defmt::write!(f, "the flash is not blank where it was erased"),
            Self::NotAsWritten => defmt::write!(f, "the flash reads back otherwise than written"),
            Self::Full => defmt::write!(f, "the flash is full until the next power-on"),
        }
    }
}

/// The result of the search in one bank.
struct Bank {
    range: Range<u32>,
    newest: Option<Record>,
    /// The first address after the newest record, or the start of the bank without one.
    newest_end: u32,
    /// The address from which the rest of the bank reads blank.
    blank_from: u32,
}

impl Bank {
    fn is_blank(&self) -> bool {
        self.blank_from == self.range.start
    }
}

/// Whether `bytes` have not been written since the erase. Compares words, since each start checks a thousand records.
fn is_blank(bytes: &[u8; record::LEN as usize]) -> bool {
    let (words, _) = bytes.as_chunks();
    words.iter().all(|word| u32::from_ne_bytes(*word) == u32::MAX)
}

impl<F: NorFlash> Log<F> {
    /// Finds the newest settings, and moves to the other bank when little space is left.
    ///
    /// For a blank or damaged flash, and once in several hundred stores, this takes as long as an erase (800 ms at most
    /// on an STM32F4). Call it before joining the bus.
    pub fn open(flash: F) -> (Self, Found) {
        const {
            assert!(
                4usize.is_multiple_of(F::WRITE_SIZE),
                "the commit word, 4 bytes, must be writable alone"
            );
            assert!((record::LEN as usize).is_multiple_of(F::READ_SIZE));
        }
        let newest = Record { sequence: 0, settings: None };
        let mut log = Self { flash, newest, sequence: 0, is_doubtful: false, space: 0..0 };
        let found = log.find().unwrap_or_else(Found::MediumFailed);
        (log, found)
    }

    /// The persistent settings; `None` if none were ever stored and the device's defaults apply.
    pub fn settings(&self) -> Option<Settings> {
        self.newest.settings
    }

    /// Makes `settings` persistent. Writes nothing if they already are, else one record, which takes 0.2 ms (0.8 ms at
    /// worst) on an STM32F4.
    ///
    /// # Errors
    /// The record could not be written and read back, or the bank is full until the next `open`. The previous settings
    /// are still persistent.
    pub fn store(&mut self, settings: Settings) -> Result<(), Error> {
        if self.newest.settings == Some(settings) && !self.is_doubtful {
            return Ok(());
        }
        let outcome = self.append(Some(settings));
        if outcome.is_err() && self.is_doubtful {
            // Writes the old settings after the rejected record.
            let _ = self.append(self.newest.settings);
        }
        outcome
    }

    /// Closes the log and returns its flash.
    pub fn close(self) -> F {
        self.flash
    }

    fn find(&mut self) -> Result<Found, Error> {
        let erase_size = F::ERASE_SIZE as u32;
        let bank_len = self.flash.capacity() as u32 / 2 / erase_size * erase_size;
        let first = self.search(0..bank_len)?;
        let second = self.search(bank_len..2 * bank_len)?;
        let second_is_newer = match (&first.newest, &second.newest) {
            (Some(first), Some(second)) => second.is_newer_than(first),
            (first, second) => first.is_none() && second.is_some(),
        };
        let (bank, other) = if second_is_newer { (second, first) } else { (first, second) };
        let Some(newest) = bank.newest else {
            let is_blank = bank.is_blank() && other.is_blank();
            // Even a bank that reads blank is erased: its last erase may have been interrupted.
            self.move_to(bank.range)?;
            return Ok(if is_blank { Found::Blank } else { Found::Damaged });
        };
        let interrupted = bank.blank_from.saturating_sub(bank.newest_end) / record::LEN;
        self.newest = newest;
        // A later record must be newer than any that may turn out valid. The same place must also get the same sequence
        // again: after a power cut in its first word, nothing else may be written there.
        self.sequence = newest.sequence.wrapping_add(interrupted);
        self.space = bank.blank_from..bank.range.end;
        // The record of an interrupted move may turn out valid too; its sequence is later than that of the next store.
        let has_moved = other.newest.is_none() && !other.is_blank();
        // The record that supersedes an interrupted one takes space.
        let least = bank_len / 4 + if interrupted > 0 { record::LEN } else { 0 };
        if has_moved || self.space.end.saturating_sub(self.space.start) < least {
            self.move_to(other.range)?;
        } else if interrupted > 0 || self.commit_again(bank.newest_end).is_err() {
            self.append(self.newest.settings)?;
        }
        Ok(if interrupted > 0 { Found::Interrupted } else { Found::Complete })
    }

    fn search(&mut self, range: Range<u32>) -> Result<Bank, Error> {
        let start = range.start;
        let mut bank = Bank { range, newest: None, newest_end: start, blank_from: start };
        // One buffer for all: returning each of a thousand records would cost a copy, 1 ms in all.
        let mut bytes = [0; record::LEN as usize];
        for at in bank.range.clone().step_by(record::LEN as usize).rev() {
            self.flash.read(at, &mut bytes).map_err(|_| Error::Refused)?;
            if is_blank(&bytes) {
                continue;
            }
            if bank.is_blank() {
                bank.blank_from = at + record::LEN;
            }
            bank.newest = Record::from_bytes(&bytes);
            if bank.newest.is_some() {
                bank.newest_end = at + record::LEN;
                break;
            }
        }
        Ok(bank)
    }

    /// Erases `bank` and writes the newest record to it.
    fn move_to(&mut self, bank: Range<u32>) -> Result<(), Error> {
        self.flash.erase(bank.start, bank.end).map_err(|_| Error::Refused)?;
        let old_space = mem::replace(&mut self.space, bank);
        self.append(self.newest.settings).inspect_err(|_| self.space = old_space)
    }

    fn append(&mut self, settings: Option<Settings>) -> Result<(), Error> {
        let at = self.space.start;
        if at >= self.space.end {
            return Err(Error::Full);
        }
        self.sequence = self.sequence.wrapping_add(1);
        self.space.start = at.saturating_add(record::LEN);
        let record = Record { sequence: self.sequence, settings };
        self.write(at, &record.to_bytes())?;
        self.newest = record;
        Ok(())
    }

    /// Rewrites the commit word of the record that ends at `end`.
    fn commit_again(&mut self, end: u32) -> Result<(), F::Error> {
        self.flash.write(end.saturating_sub(record::COMMIT.len() as u32), &record::COMMIT)
    }

    fn write(&mut self, at: u32, bytes: &[u8; record::LEN as usize]) -> Result<(), Error> {
        const COMMIT_AT: usize = record::LEN as usize - record::COMMIT.len();
        let (content, commit) = bytes.split_at(COMMIT_AT);
        if !is_blank(&self.read(at)?) {
            return Err(Error::NotBlank);
        }
        self.flash.write(at, content).map_err(|_| Error::Refused)?;
        if !self.read(at)?.starts_with(content) {
            return Err(Error::NotAsWritten);
        }
        // The read-back decides, as at the next open, whatever the flash reports for this last word.
        let _ = self.flash.write(at + COMMIT_AT as u32, commit);
        self.is_doubtful = true;
        let written = self.read(at)?;
        self.is_doubtful = false;
        if written == *bytes { Ok(()) } else { Err(Error::NotAsWritten) }
    }

    fn read(&mut self, at: u32) -> Result<[u8; record::LEN as usize], Error> {
        let mut bytes = [0; record::LEN as usize];
        self.flash.read(at, &mut bytes).map_err(|_| Error::Refused)?;
        Ok(bytes)
    }
}
