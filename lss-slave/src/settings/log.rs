//! The settings log: records appended to one of two banks of flash. The newest valid record holds the settings, and
//! refers to the parameters, which were written before it.
//!
//! # The promise
//! Whenever the power fails, the next [`Log::open`] finds the settings and parameters of the last [`Log::store`] that
//! returned `Ok`, or those of a later one that did not return; never older ones, never a mix. The result of an `open`
//! holds until the next store. Six rules ensure this:
//! - A record is valid only with its CRC and with its commit word, which is written after the rest was read back.
//! - Parameters are written and read back before the record that refers to them. A move copies them first.
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
    parameters::{self, HEADER, Parameter},
    record::{self, PARAMETERS_LEN, Record, Reference},
};
use crate::application::copy;

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
    /// The newest record is valid, but the parameters to which it refers are damaged; their defaults apply.
    ParametersDamaged,
    /// The flash could not be read, erased or written. The settings that were found apply, but storing may fail.
    MediumFailed(Error),
}

/// The settings log, on a flash that holds nothing else.
///
/// The flash is used as two banks of equal size, each a multiple of the erase size; a bank of 16 KB has room for 512
/// records. `open` moves to the other bank when less than a quarter of the current one is left, or no room for a record
/// with all parameters.
///
/// `PARAMETERS` is the greatest number of bytes of the parameters, see [`Node::PARAMETERS`](crate::Node::PARAMETERS).
/// It must not exceed the [`capacity`](parameters::capacity) of a bank: then a store finds the flash full.
pub struct Log<F, const PARAMETERS: usize = 0> {
    flash: F,
    newest: Record,
    /// The parameters of the newest record.
    stored: Stored<PARAMETERS>,
    /// The sequence number of the last record written or attempted.
    sequence: u32,
    /// The last record was written but could not be read back. A later `open` may find it valid.
    is_doubtful: bool,
    /// The blank space in the bank with the newest record.
    space: Range<u32>,
}

/// The parameters of a record.
struct Stored<const PARAMETERS: usize> {
    reference: Option<Reference>,
    /// The first address of the bank with the record.
    bank: u32,
    /// The parameters that the node has taken, or those of the last store.
    bytes: [u8; PARAMETERS],
    len: usize,
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
    /// The parameters to which the newest record refers.
    reference: Option<Reference>,
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
        Self::open_with_parameters(flash)
    }
}

impl<F: NorFlash, const PARAMETERS: usize> Log<F, PARAMETERS> {
    /// Opens the log as [`open`](Log::open) does, for a node with parameters. [`restore`](Self::restore) must follow.
    pub fn open_with_parameters(flash: F) -> (Self, Found) {
        const {
            assert!(
                4usize.is_multiple_of(F::WRITE_SIZE),
                "the commit word, 4 bytes, must be writable alone"
            );
            assert!((record::LEN as usize).is_multiple_of(F::READ_SIZE));
            assert!(PARAMETERS < u16::MAX as usize, "the parameters take too many bytes");
        }
        let newest = Record { sequence: 0, settings: None };
        let stored = Stored { reference: None, bank: 0, bytes: [0; PARAMETERS], len: 0 };
        let mut log = Self { flash, newest, stored, sequence: 0, is_doubtful: false, space: 0..0 };
        let found = log.find().unwrap_or_else(Found::MediumFailed);
        (log, found)
    }

    /// The persistent settings; `None` if none were ever stored and the device's defaults apply.
    pub fn settings(&self) -> Option<Settings> {
        self.newest.settings
    }

    /// Passes the persistent parameters to [`Node::restore`](crate::Node::restore), which says whether it takes each.
    /// Call it once, before the first store: [`parameters`](Self::parameters) are those that were taken.
    ///
    /// # Errors
    /// The flash cannot be read.
    pub fn restore(&mut self, mut take: impl FnMut(&Parameter<'_>) -> bool) -> Result<(), Error> {
        let Some(reference) = self.stored.reference.filter(|_| PARAMETERS > 0) else {
            return Ok(());
        };
        let Stored { bank, bytes, len, .. } = &mut self.stored;
        let mut blob = Blob { flash: &mut self.flash, bank: *bank, reference, at: 0 };
        *len = 0;
        while blob.rest() >= HEADER {
            let mut header = [0; HEADER];
            blob.read(&mut header)?;
            let value_len = usize::from(parameters::value_len(header)).min(blob.rest());
            let to = bytes.get_mut(*len..).unwrap_or_default();
            // A longer one is none of this node's, whose parameters all fit.
            let Some(to) = to.get_mut(..HEADER.saturating_add(value_len)) else {
                blob.skip(value_len);
                continue;
            };
            let (to_header, value) = to.split_at_mut(HEADER.min(to.len()));
            copy(&header, 0, to_header);
            blob.read(value)?;
            if Parameter::first_of(to).is_some_and(|parameter| take(&parameter)) {
                *len = len.saturating_add(to.len());
            }
        }
        Ok(())
    }

    /// The persistent parameters, packed.
    pub fn parameters(&self) -> &[u8] {
        let len = if PARAMETERS > 0 { self.stored.len } else { 0 };
        self.stored.bytes.get(..len).unwrap_or_default()
    }

    /// Makes `settings` persistent and keeps the parameters. Writes nothing if the settings already are, else one
    /// record, which takes 0.2 ms (0.8 ms at worst) on an STM32F4.
    ///
    /// # Errors
    /// The record could not be written and read back, or the bank is full until the next `open`. The previous settings
    /// are still persistent.
    pub fn store(&mut self, settings: Settings) -> Result<(), Error> {
        if self.newest.settings == Some(settings) && !self.is_doubtful {
            return Ok(());
        }
        let outcome = self.append(Some(settings), self.stored.reference);
        self.end_store(outcome)
    }

    /// Makes `settings` and these packed parameters persistent. Parameters that already are cost nothing; others take
    /// as long as a record for every 24 bytes, before the record itself.
    ///
    /// # Errors
    /// As for [`store`](Self::store): the previous settings and parameters are still persistent. [`Error::Full`] also
    /// if there are more bytes than `PARAMETERS`.
    pub fn store_with_parameters(
        &mut self,
        settings: Settings,
        parameters: &[u8],
    ) -> Result<(), Error> {
        if PARAMETERS == 0 || parameters == self.parameters() {
            return self.store(settings);
        }
        let outcome = self.append_with_parameters(settings, parameters);
        self.end_store(outcome)
    }

    /// After a store that failed, writes the old settings behind a rejected record.
    fn end_store(&mut self, outcome: Result<(), Error>) -> Result<(), Error> {
        if outcome.is_err() && self.is_doubtful {
            let _ = self.append(self.newest.settings, self.stored.reference);
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
        let mut are_damaged = false;
        if PARAMETERS > 0 {
            self.stored.bank = bank.range.start;
            are_damaged = !self.are_intact(bank.reference, bank.newest_end)?;
            self.stored.reference = bank.reference.filter(|_| !are_damaged);
        }
        // A later record must be newer than any that may turn out valid. The same place must also get the same sequence
        // again: after a power cut in its first word, nothing else may be written there.
        self.sequence = newest.sequence.wrapping_add(interrupted);
        self.space = bank.blank_from..bank.range.end;
        // The record of an interrupted move may turn out valid too; its sequence is later than that of the next store.
        let has_moved = other.newest.is_none() && !other.is_blank();
        // The record that supersedes an interrupted one takes space.
        let mut least = bank_len / 4;
        if PARAMETERS > 0 {
            least = least.max((PARAMETERS.div_ceil(PARAMETERS_LEN) as u32 + 1) * record::LEN);
        }
        least += if interrupted > 0 { record::LEN } else { 0 };
        if has_moved || self.space.end.saturating_sub(self.space.start) < least {
            self.move_to(other.range)?;
        } else if interrupted > 0 || are_damaged || self.commit_again(bank.newest_end).is_err() {
            self.append(self.newest.settings, self.stored.reference)?;
        }
        if are_damaged {
            return Ok(Found::ParametersDamaged);
        }
        Ok(if interrupted > 0 { Found::Interrupted } else { Found::Complete })
    }

    fn search(&mut self, range: Range<u32>) -> Result<Bank, Error> {
        let start = range.start;
        let mut bank =
            Bank { range, newest: None, reference: None, newest_end: start, blank_from: start };
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
                if PARAMETERS > 0 {
                    bank.reference = Reference::of_record(&bytes);
                }
                break;
            }
        }
        Ok(bank)
    }

    /// Erases `bank`, and copies the newest record to it with its parameters.
    fn move_to(&mut self, bank: Range<u32>) -> Result<(), Error> {
        self.flash.erase(bank.start, bank.end).map_err(|_| Error::Refused)?;
        let start = bank.start;
        let old_space = mem::replace(&mut self.space, bank);
        let outcome = match self.stored.reference {
            Some(reference) if PARAMETERS > 0 => self.copy(reference, start),
            _ => self.append(self.newest.settings, None),
        };
        if PARAMETERS > 0 && outcome.is_ok() {
            self.stored.bank = start;
        }
        outcome.inspect_err(|_| self.space = old_space)
    }

    /// Appends the newest record with a copy of its parameters.
    fn copy(&mut self, old: Reference, bank: u32) -> Result<(), Error> {
        let source = Source::Flash { bank: self.stored.bank, reference: old };
        let new = self.append_parameters(bank, old.len, source)?;
        if new.crc != old.crc {
            return Err(Error::NotAsWritten);
        }
        self.append(self.newest.settings, Some(new))
    }

    fn append_with_parameters(
        &mut self,
        settings: Settings,
        parameters: &[u8],
    ) -> Result<(), Error> {
        let mut reference = None;
        if parameters.len() > PARAMETERS {
            return Err(Error::Full);
        }
        if !parameters.is_empty() {
            let len = parameters.len() as u16;
            let source = Source::Bytes(parameters);
            reference = Some(self.append_parameters(self.stored.bank, len, source)?);
        }
        self.append(Some(settings), reference)?;
        let Stored { bytes, len, .. } = &mut self.stored;
        *len = copy(parameters, 0, bytes);
        Ok(())
    }

    /// Appends parameters, which are copied part by part. Writes nothing if they do not fit with their record.
    #[inline(never)] // It has two callers.
    fn append_parameters(
        &mut self,
        bank: u32,
        len: u16,
        source: Source<'_>,
    ) -> Result<Reference, Error> {
        let first = self.space.start.saturating_sub(bank) / record::LEN;
        let mut reference =
            Reference { first: first.try_into().map_err(|_| Error::Full)?, len, crc: u32::MAX };
        let space = self.space.end.saturating_sub(self.space.start) / record::LEN;
        if reference.places() >= space {
            return Err(Error::Full);
        }
        for at in (0..usize::from(len)).step_by(PARAMETERS_LEN) {
            let mut part = [0xFF; PARAMETERS_LEN];
            let rest = usize::from(len).saturating_sub(at).min(PARAMETERS_LEN);
            let of_len = part.get_mut(..rest).unwrap_or_default();
            match source {
                Source::Bytes(bytes) => {
                    copy(bytes, at, of_len);
                }
                Source::Flash { bank, reference } => {
                    Blob { flash: &mut self.flash, bank, reference, at }.read(of_len)?;
                }
            }
            reference.crc = record::crc32_of_more(reference.crc, of_len);
            let at = self.take_place()?;
            let bytes = record::parameters_to_bytes(self.sequence, part);
            self.write_once(at, &bytes)?;
        }
        reference.crc = !reference.crc;
        Ok(reference)
    }

    /// Whether there are no parameters, or they are complete and undamaged, before their record.
    fn are_intact(&mut self, reference: Option<Reference>, record_end: u32) -> Result<bool, Error> {
        let Some(reference) = reference else {
            return Ok(true);
        };
        let places = u32::from(reference.first).saturating_add(reference.places());
        let end = places.saturating_mul(record::LEN).saturating_add(self.stored.bank);
        if end >= record_end {
            return Ok(false);
        }
        let mut blob = Blob { flash: &mut self.flash, bank: self.stored.bank, reference, at: 0 };
        let mut crc = u32::MAX;
        while blob.rest() > 0 {
            let mut part = [0; PARAMETERS_LEN];
            let part = part.get_mut(..blob.rest().min(PARAMETERS_LEN)).unwrap_or_default();
            blob.read(part)?;
            crc = record::crc32_of_more(crc, part);
        }
        Ok(!crc == reference.crc)
    }

    fn append(
        &mut self,
        settings: Option<Settings>,
        reference: Option<Reference>,
    ) -> Result<(), Error> {
        let at = self.take_place()?;
        let record = Record { sequence: self.sequence, settings };
        self.write(at, &record.to_bytes(reference.filter(|_| PARAMETERS > 0)))?;
        self.newest = record;
        if PARAMETERS > 0 {
            self.stored.reference = reference;
        }
        Ok(())
    }

    /// The next place for 32 bytes, whose sequence number is then [`sequence`](Self::sequence).
    fn take_place(&mut self) -> Result<u32, Error> {
        let at = self.space.start;
        if at >= self.space.end {
            return Err(Error::Full);
        }
        self.sequence = self.sequence.wrapping_add(1);
        self.space.start = at.saturating_add(record::LEN);
        Ok(at)
    }

    /// Rewrites the commit word of the record that ends at `end`.
    fn commit_again(&mut self, end: u32) -> Result<(), F::Error> {
        self.flash.write(end.saturating_sub(record::COMMIT.len() as u32), &record::COMMIT)
    }

    fn write(&mut self, at: u32, bytes: &[u8; record::LEN as usize]) -> Result<(), Error> {
        const COMMIT_AT: usize = record::LEN as usize - record::COMMIT.len();
        let (content, commit) = bytes.split_at(COMMIT_AT);
        self.write_once(at, content)?;
        // The read-back decides, as at the next open, whatever the flash reports for this last word.
        let _ = self.flash.write(at + COMMIT_AT as u32, commit);
        self.is_doubtful = true;
        let written = self.read(at)?;
        self.is_doubtful = false;
        if written == *bytes { Ok(()) } else { Err(Error::NotAsWritten) }
    }

    /// Writes a blank place, or its beginning, and reads it back.
    fn write_once(&mut self, at: u32, content: &[u8]) -> Result<(), Error> {
        if !is_blank(&self.read(at)?) {
            return Err(Error::NotBlank);
        }
        self.flash.write(at, content).map_err(|_| Error::Refused)?;
        if self.read(at)?.starts_with(content) { Ok(()) } else { Err(Error::NotAsWritten) }
    }

    fn read(&mut self, at: u32) -> Result<[u8; record::LEN as usize], Error> {
        let mut bytes = [0; record::LEN as usize];
        self.flash.read(at, &mut bytes).map_err(|_| Error::Refused)?;
        Ok(bytes)
    }
}

/// The place from which parameters are copied.
#[derive(Clone, Copy)]
enum Source<'a> {
    Bytes(&'a [u8]),
    Flash { bank: u32, reference: Reference },
}

/// The parameters of a record in the flash, read from the start to the end.
struct Blob<'a, F> {
    flash: &'a mut F,
    bank: u32,
    reference: Reference,
    /// The number of bytes before the next one to read.
    at: usize,
}

impl<F: NorFlash> Blob<'_, F> {
    /// The number of bytes that have not been read.
    fn rest(&self) -> usize {
        usize::from(self.reference.len).saturating_sub(self.at)
    }

    fn skip(&mut self, bytes: usize) {
        self.at = self.at.saturating_add(bytes);
    }

    fn read(&mut self, mut to: &mut [u8]) -> Result<(), Error> {
        while !to.is_empty() {
            let place = (self.at / PARAMETERS_LEN) as u32;
            let address = u32::from(self.reference.first)
                .saturating_add(place)
                .saturating_mul(record::LEN)
                .saturating_add(self.bank);
            let mut bytes = [0; record::LEN as usize];
            self.flash.read(address, &mut bytes).map_err(|_| Error::Refused)?;
            let part = record::parameters_from_bytes(&bytes);
            let read = copy(part, self.at % PARAMETERS_LEN, to);
            self.skip(read);
            to = to.get_mut(read..).unwrap_or_default();
        }
        Ok(())
    }
}
