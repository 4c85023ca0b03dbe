//! The settings log: records appended to one of two banks of flash. The newest valid record holds the settings, and
//! refers to the parameters, which were written before it.
//!
//! # The promise
//! Whenever the power fails, the next [`Log::open`] finds the settings and parameters of the last [`Log::store`] that
//! returned `Ok`, or those of a later one that did not return; never older ones, never a mix. The result of an `open`
//! holds until the next store. Six rules ensure this for as many as 255 starts in a row that are cut:
//! - A record is valid with its CRC, which is written after the rest was read back. Its commit word follows.
//! - Parameters are written and read back before the record that refers to them.
//! - A word whose write was interrupted by a power cut may read differently at each start. A record is certain if its
//!   commit word was begun, since the words before it are complete then. `open` appends the record that it accepts once
//!   more, unless it is certain and the last one.
//! - Each word is written once after an erase, and only if it reads blank. Where the power failed in the first word of
//!   a place and it reads blank nevertheless, the same word follows: it is the sequence number, which counts places.
//! - A bank is erased only by `open`, never by `store`: an erase stops the CPU for up to 800 ms, which a node on the
//!   bus cannot afford. It is the bank without the newest record, after that record is certain or its bank is full.
//! - The first place of a bank is written when its erase is complete, and only then may others follow.
//!
//! So it is in flash whose program unit is a word or less; for the other rules of wider units see [`wide`].

mod wide;

use core::{error, fmt, mem, ops::Range};

use embedded_storage::nor_flash::NorFlash;

use super::{
    Settings,
    parameters::{self, HEADER, Parameter},
    record::{self, Changes, OtherBank, PART_LEN, Record, Reference},
};
use crate::bytes::copy;

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
/// records, or for 341, 256 or 170 where the program unit has 8, 16 or 32 bytes. A store that finds no room in one bank
/// continues in the other, which the `open` before has erased.
///
/// `STORED_LEN` is the greatest number of bytes of the packed parameters. It must not exceed the
/// [`capacity`](parameters::capacity) of a bank: then a store finds the flash full.
pub struct Log<F, const STORED_LEN: usize = 0> {
    flash: F,
    newest: Newest,
    /// The parameters of the newest record that the node has taken, or those of the last store.
    taken: [u8; STORED_LEN],
    taken_len: usize,
    /// The newest record has no other parameters.
    has_taken_all: bool,
    /// The last record was written but could not be read back. A later `open` may find it valid.
    is_doubtful: bool,
    /// What the next record says of the other bank where units are wide.
    other_is: OtherBank,
    /// The blank space in the bank with the newest record.
    space: Space,
    /// The blank space in the other bank; empty if its erase is not known to be complete.
    other: Space,
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
    /// Both banks are full until the next [`Log::open`].
    Full,
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Refused => "the flash reports an error",
            Self::NotBlank => "the flash is not blank where it was erased",
            Self::NotAsWritten => "the flash reads back otherwise than written",
            Self::Full => {
                "the flash is full: reset the node (NMT command 81h) or switch it off and on"
            }
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
            Self::Full => defmt::write!(
                f,
                "the flash is full: reset the node (NMT command 81h) or switch it off and on"
            ),
        }
    }
}

/// The places in a bank that have not been written.
struct Space {
    range: Range<u32>,
    /// The sequence number of the first of them.
    sequence: u32,
    /// The first address of the bank.
    bank: u32,
}

impl Space {
    const NONE: Self = Self { range: 0..0, sequence: 0, bank: 0 };

    /// The number of places.
    fn len<F: Layout>(&self) -> u32 {
        self.range.end.saturating_sub(self.range.start) / F::PLACE
    }

    /// The sequence number of the last of them.
    fn last_sequence<F: Layout>(&self) -> u32 {
        self.sequence.wrapping_add(self.len::<F>()).wrapping_sub(1)
    }

    /// The address and the sequence number of the next place.
    fn take<F: Layout>(&mut self) -> Result<(u32, u32), Error> {
        if self.len::<F>() == 0 {
            return Err(Error::Full);
        }
        let place = (self.range.start, self.sequence);
        self.range.start = self.range.start.saturating_add(F::PLACE);
        self.sequence = self.sequence.wrapping_add(1);
        Ok(place)
    }
}

/// The newest valid record.
#[derive(Clone, Copy)]
struct Newest {
    record: Record,
    at: u32,
    /// The first address of its bank.
    bank: u32,
}

impl Newest {
    /// The part of the parameters with this number; `None` if the log is damaged.
    fn part<F: NorFlash>(
        &self,
        flash: &mut F,
        number: u16,
    ) -> Result<Option<[u8; PART_LEN]>, Error> {
        let mut end = self.place::<F>();
        let mut reference = self.record.parameters;
        // Each reference lies before the one from which it was found.
        while let Some(Reference { first, changes, .. }) = reference.filter(|it| it.end() <= end) {
            let Some(Changes { parts, others }) = changes else {
                let place = u32::from(first).saturating_add(number.into());
                let is_there = reference.is_some_and(|it| place < it.end());
                let bytes = read(flash, self.address::<F>(place))?;
                return Ok(is_there.then_some(record::part_from_bytes(&bytes).1));
            };
            for place in first..first.saturating_add(parts) {
                let bytes = read(flash, self.address::<F>(place.into()))?;
                let (found, part) = record::part_from_bytes(&bytes);
                if found == number {
                    return Ok(Some(part));
                }
            }
            if others >= first {
                break;
            }
            end = others.into();
            reference = Reference::of_record(&read(flash, self.address::<F>(end))?);
        }
        Ok(None)
    }

    /// Whether the parameters are complete and undamaged.
    fn is_intact<F: NorFlash>(&self, flash: &mut F) -> Result<bool, Error> {
        let Some(Reference { len, crc, .. }) = self.record.parameters else {
            return Ok(true);
        };
        let mut found = u32::MAX;
        for (number, len) in parts(len) {
            let part = match self.part(flash, number) {
                // A wide unit that cannot be read is damaged.
                Err(_) if F::IS_WIDE => None,
                part => part?,
            };
            let Some(part) = part else {
                return Ok(false);
            };
            found = record::crc32_of_more(found, part.get(..len).unwrap_or_default());
        }
        Ok(!found == crc)
    }

    fn place<F: Layout>(&self) -> u32 {
        self.at.saturating_sub(self.bank) / F::PLACE
    }

    fn address<F: Layout>(&self, place: u32) -> u32 {
        place.saturating_mul(F::PLACE).saturating_add(self.bank)
    }
}

/// The numbers of the parts of parameters of `len` bytes, and the length of each.
fn parts(len: u16) -> impl Iterator<Item = (u16, usize)> {
    let starts = (0..usize::from(len)).step_by(PART_LEN);
    (0..).zip(starts.map(move |start| usize::from(len).saturating_sub(start).min(PART_LEN)))
}

/// The part of packed parameters with this number, if there is one; unused bytes are FF.
fn part_of(packed: &[u8], number: u16) -> Option<[u8; PART_LEN]> {
    let mut part = [0xFF; PART_LEN];
    (copy(packed, usize::from(number).saturating_mul(PART_LEN), &mut part) > 0).then_some(part)
}

/// The 32 bytes of a place.
fn read<F: NorFlash>(flash: &mut F, at: u32) -> Result<[u8; record::LEN as usize], Error> {
    let mut bytes = [0; record::LEN as usize];
    if F::IS_WIDE {
        wide::read(flash, at.saturating_add(F::WRITE_SIZE as u32), &mut bytes)?;
        return Ok(bytes);
    }
    flash.read(at, &mut bytes).map_err(|_| Error::Refused)?;
    Ok(bytes)
}

/// The places of a flash.
trait Layout: NorFlash {
    /// A program unit is larger than a word.
    const IS_WIDE: bool = record::is_wide(Self::WRITE_SIZE);
    /// The number of bytes that a place takes.
    const PLACE: u32 = record::place_len(Self::WRITE_SIZE);
}

impl<F: NorFlash> Layout for F {}

/// The result of the search in one bank.
struct Bank {
    range: Range<u32>,
    newest: Option<Newest>,
    /// The newest record is certain.
    is_certain: bool,
    /// The sequence number of the first place, if the bank was erased completely and nothing was written since.
    erased: Option<u32>,
    /// The address from which the rest of the bank reads blank.
    blank_from: u32,
}

impl Bank {
    fn is_blank(&self) -> bool {
        self.blank_from == self.range.start || self.erased.is_some()
    }

    /// The blank space, if the place at `at` has this sequence number.
    fn space(&self, at: u32, sequence: u32) -> Space {
        let places = self.blank_from.saturating_sub(at) / record::LEN;
        Space {
            range: self.blank_from..self.range.end,
            sequence: sequence.wrapping_add(places),
            bank: self.range.start,
        }
    }
}

/// Whether `bytes` have not been written since the erase. Compares words, since each start checks a thousand records.
fn is_blank(bytes: &[u8; record::LEN as usize]) -> bool {
    let (words, _) = bytes.as_chunks();
    words.iter().all(|word| u32::from_ne_bytes(*word) == u32::MAX)
}

impl<F: NorFlash> Log<F> {
    /// Finds the newest settings, and erases the bank that does not hold them if it was used since its last erase.
    ///
    /// The latter takes as long as an erase (800 ms at most on an STM32F4), once in some hundred stores; both banks are
    /// erased at the first start of a new device. Call it before joining the bus.
    pub fn open(flash: F) -> (Self, Found) {
        Self::open_with_parameters(flash)
    }
}

impl<F: NorFlash, const STORED_LEN: usize> Log<F, STORED_LEN> {
    /// Opens the log as [`open`](Log::open) does, for a node with parameters. [`restore`](Self::restore) must follow.
    pub fn open_with_parameters(flash: F) -> (Self, Found) {
        const {
            assert!(
                matches!(F::WRITE_SIZE, 1 | 2 | 4 | 8 | 16 | 32),
                "the program unit must be 1, 2, 4, 8, 16 or 32 bytes"
            );
            let read_at_once = if F::IS_WIDE { F::WRITE_SIZE } else { record::LEN as usize };
            assert!(read_at_once.is_multiple_of(F::READ_SIZE));
            assert!(STORED_LEN < u16::MAX as usize, "the parameters take too many bytes");
        }
        let record = Record { sequence: 0, settings: None, parameters: None };
        let mut log = Self {
            flash,
            newest: Newest { record, at: 0, bank: 0 },
            taken: [0; STORED_LEN],
            taken_len: 0,
            has_taken_all: false,
            is_doubtful: false,
            other_is: OtherBank::Used,
            space: Space::NONE,
            other: Space::NONE,
        };
        let found = if F::IS_WIDE { log.find_wide() } else { log.find() };
        let found = found.unwrap_or_else(Found::MediumFailed);
        (log, found)
    }

    /// The persistent settings; `None` if none were ever stored and the device's defaults apply.
    pub fn settings(&self) -> Option<Settings> {
        self.newest.record.settings
    }

    /// Passes the persistent parameters to the node, which says whether it takes each. Call it once, before the first
    /// store: [`parameters`](Self::parameters) are those that were taken.
    ///
    /// # Errors
    /// The flash cannot be read.
    pub fn restore(&mut self, mut take: impl FnMut(&Parameter<'_>) -> bool) -> Result<(), Error> {
        let mut blob = Blob { flash: &mut self.flash, newest: self.newest, at: 0, last: None };
        let mut has_taken_all = true;
        self.taken_len = 0;
        while blob.rest() >= HEADER {
            let mut header = [0; HEADER];
            blob.read(&mut header)?;
            let value_len = usize::from(parameters::value_len(header)).min(blob.rest());
            let to = self.taken.get_mut(self.taken_len..).unwrap_or_default();
            // A longer one is none of this node's, whose parameters all fit.
            let Some(to) = to.get_mut(..HEADER.saturating_add(value_len)) else {
                blob.skip(value_len);
                has_taken_all = false;
                continue;
            };
            let (to_header, value) = to.split_at_mut(HEADER.min(to.len()));
            copy(&header, 0, to_header);
            blob.read(value)?;
            if Parameter::first_of(to).is_some_and(|parameter| take(&parameter)) {
                self.taken_len = self.taken_len.saturating_add(to.len());
            } else {
                has_taken_all = false;
            }
        }
        self.has_taken_all = has_taken_all && blob.rest() == 0;
        Ok(())
    }

    /// The persistent parameters, packed.
    pub fn parameters(&self) -> &[u8] {
        self.taken.get(..self.taken_len).unwrap_or_default()
    }

    /// Makes `settings` persistent and keeps the parameters. Writes nothing if the settings already are, else one
    /// record, which takes 0.2 ms (0.8 ms at worst) on an STM32F4. Where one bank is full, the parameters are copied to
    /// the other before it.
    ///
    /// # Errors
    /// The record could not be written and read back, or the flash is full until the next `open`. The previous settings
    /// are still persistent.
    pub fn store(&mut self, settings: Settings) -> Result<(), Error> {
        if self.settings() == Some(settings) && !self.is_doubtful {
            return Ok(());
        }
        self.put_or_restore(settings, None)
    }

    /// Makes `settings` and these packed parameters persistent. Parameters that already are cost nothing; each run of
    /// 24 bytes that differs takes as long as a record, before the record itself.
    ///
    /// # Errors
    /// As for [`store`](Self::store): the previous settings and parameters are still persistent. [`Error::Full`] also
    /// if there are more bytes than `STORED_LEN`.
    pub fn store_with_parameters(
        &mut self,
        settings: Settings,
        parameters: &[u8],
    ) -> Result<(), Error> {
        if parameters == self.parameters() {
            return self.store(settings);
        }
        if parameters.len() > STORED_LEN {
            return Err(Error::Full);
        }
        self.put_or_restore(settings, Some(parameters))?;
        self.taken_len = copy(parameters, 0, &mut self.taken);
        self.has_taken_all = true;
        Ok(())
    }

    /// Closes the log and returns its flash.
    pub fn close(self) -> F {
        self.flash
    }

    fn find(&mut self) -> Result<Found, Error> {
        let bank_len = self.bank_len();
        let first = self.search(0..bank_len)?;
        let second = self.search(bank_len..bank_len.saturating_mul(2))?;
        let second_is_newer = match (&first.newest, &second.newest) {
            (Some(first), Some(second)) => {
                record::is_newer(second.record.sequence, first.record.sequence)
            }
            (first, second) => first.is_none() && second.is_some(),
        };
        let (bank, other) = if second_is_newer { (second, first) } else { (first, second) };
        let Some(newest) = bank.newest else {
            let is_blank = bank.is_blank() && other.is_blank();
            // Even a bank that reads blank is erased: its last erase may have been interrupted.
            self.erase(bank.range)?;
            self.put(None, None)?;
            self.erase(other.range)?;
            return Ok(if is_blank { Found::Blank } else { Found::Damaged });
        };
        self.newest = newest;
        self.space = bank.space(newest.at, newest.record.sequence);
        let is_interrupted = bank.blank_from > newest.at.saturating_add(record::LEN);
        let is_intact = newest.is_intact(&mut self.flash)?;
        if !is_intact {
            self.newest.record.parameters = None;
        }
        let is_certain = bank.is_certain && is_intact && !is_interrupted
            || self.append(newest.record.settings, None, false).is_ok();
        match other.erased {
            Some(sequence) if record::is_newer(sequence, self.space.last_sequence::<F>()) => {
                self.other = other.space(other.range.start, sequence);
            }
            _ => self.erase(other.range)?,
        }
        if !is_certain {
            self.put(newest.record.settings, None)?;
        }
        Ok(match (is_intact, is_interrupted) {
            (false, _) => Found::ParametersDamaged,
            (true, true) => Found::Interrupted,
            (true, false) => Found::Complete,
        })
    }

    /// The number of bytes that are erased with a bank.
    fn bank_len(&self) -> u32 {
        let erase_size = F::ERASE_SIZE as u32;
        self.flash.capacity() as u32 / 2 / erase_size * erase_size
    }

    fn search(&mut self, range: Range<u32>) -> Result<Bank, Error> {
        let start = range.start;
        let mut bank =
            Bank { range, newest: None, is_certain: false, erased: None, blank_from: start };
        // One buffer for all: returning each of a thousand records would cost a copy, 1 ms in all.
        let mut bytes = [0; record::LEN as usize];
        for at in bank.range.clone().step_by(record::LEN as usize).rev() {
            self.flash.read(at, &mut bytes).map_err(|_| Error::Refused)?;
            if is_blank(&bytes) {
                continue;
            }
            if bank.blank_from == start {
                bank.blank_from = at.saturating_add(record::LEN);
                bank.erased = record::mark_from_bytes(&bytes).filter(|_| at == start);
            }
            if let Some(record) = Record::from_bytes(&bytes) {
                bank.newest = Some(Newest { record, at, bank: start });
                bank.is_certain = record::is_certain(&bytes);
                break;
            }
        }
        Ok(bank)
    }

    /// Erases the bank without the newest record.
    fn erase(&mut self, bank: Range<u32>) -> Result<(), Error> {
        if record::mark_from_bytes(&read(&mut self.flash, bank.start)?).is_some() {
            // An interrupted erase may leave the mark as it is.
            let at = bank.start.saturating_add(record::VOID_AT);
            self.flash.write(at, &record::VOID).map_err(|_| Error::Refused)?;
        }
        self.flash.erase(bank.start, bank.end).map_err(|_| Error::Refused)?;
        // A record that is left would count, since it comes after those that follow.
        if self.search(bank.clone())?.newest.is_some() {
            return Err(Error::NotBlank);
        }
        // Later than any in the other bank.
        let places = bank.end.saturating_sub(bank.start) / record::LEN;
        let sequence = self.newest.record.sequence.wrapping_add(places);
        self.write_part(bank.start, &record::mark_to_bytes(sequence), record::MARK_LEN)?;
        let range = bank.start.saturating_add(record::LEN)..bank.end;
        self.other = Space { range, sequence: sequence.wrapping_add(1), bank: bank.start };
        Ok(())
    }

    /// Makes `settings` persistent, or else leaves the old ones so.
    fn put_or_restore(&mut self, settings: Settings, new: Option<&[u8]>) -> Result<(), Error> {
        let outcome = self.put(Some(settings), new);
        if outcome.is_err() && self.is_doubtful {
            let _ = self.put(self.settings(), None);
        }
        outcome
    }

    /// Appends a record with `new` parameters, or with those of the newest one, where there is room.
    fn put(&mut self, settings: Option<Settings>, new: Option<&[u8]>) -> Result<(), Error> {
        match self.append(settings, new, false) {
            Err(Error::Full) => {}
            outcome => return outcome,
        }
        self.put_in_other(settings, new)
    }

    /// Appends a record in the other bank, with all its parameters.
    fn put_in_other(
        &mut self,
        settings: Option<Settings>,
        new: Option<&[u8]>,
    ) -> Result<(), Error> {
        mem::swap(&mut self.space, &mut self.other);
        let outcome = self.append(settings, new, true);
        // A doubtful record there would be newer than the old one in this bank.
        let has_moved =
            outcome.is_ok() || self.is_doubtful && self.append(self.settings(), None, true).is_ok();
        if has_moved {
            self.other = Space::NONE;
        } else {
            mem::swap(&mut self.space, &mut self.other);
        }
        outcome
    }

    /// Appends a record in the bank with the newest one, after the parameters that differ, or in the other one, after
    /// all parameters. Writes nothing if they do not fit.
    fn append(
        &mut self,
        settings: Option<Settings>,
        new: Option<&[u8]>,
        in_other: bool,
    ) -> Result<(), Error> {
        let outcome = self.append_once(settings, new, in_other);
        if F::IS_WIDE { self.pass_torn_places(outcome, settings, new, in_other) } else { outcome }
    }

    fn append_once(
        &mut self,
        settings: Option<Settings>,
        new: Option<&[u8]>,
        in_other: bool,
    ) -> Result<(), Error> {
        let parameters = match new {
            None if !in_other => self.newest.record.parameters,
            _ => self.append_parameters(new, in_other)?,
        };
        let (at, sequence) = self.take()?;
        let record = Record { sequence, settings, parameters };
        if F::IS_WIDE {
            self.write_wide(at, record, in_other)?;
        } else {
            self.write(at, &record.to_bytes())?;
        }
        self.newest = Newest { record, at, bank: self.space.bank };
        Ok(())
    }

    fn append_parameters(
        &mut self,
        new: Option<&[u8]>,
        in_other: bool,
    ) -> Result<Option<Reference>, Error> {
        let old = self.newest;
        let stored = old.record.parameters;
        let len = new.map_or(stored.map_or(0, |stored| stored.len), |new| new.len() as u16);
        if len == 0 {
            return Ok(None);
        }
        let keeps_some = !in_other && stored.is_some() && self.has_taken_all;
        let new_part = |number| new.and_then(|new| part_of(new, number));
        let is_kept =
            |log: &Self, number, part| keeps_some && part_of(log.parameters(), number) == part;
        let changed = parts(len).filter(|(number, _)| !is_kept(self, *number, new_part(*number)));
        // In the release image, `count` would keep its panic.
        let changed = changed.fold(0_u16, |count, _| count.saturating_add(1));
        if u32::from(changed) >= self.space.len::<F>() {
            return Err(Error::Full);
        }
        let first = self.space.range.start.saturating_sub(self.space.bank) / F::PLACE;
        let first = first.try_into().map_err(|_| Error::Full)?;
        let mut crc = u32::MAX;
        for (number, len) in parts(len) {
            let part = match new {
                Some(_) => new_part(number),
                None => old.part(&mut self.flash, number)?,
            };
            let bytes = part.ok_or(Error::NotAsWritten)?;
            crc = record::crc32_of_more(crc, bytes.get(..len).unwrap_or_default());
            if !is_kept(self, number, part) {
                let (at, sequence) = self.take()?;
                let place = record::part_to_bytes(sequence, number, &bytes);
                if F::IS_WIDE {
                    self.write_once(at, &place)?;
                } else {
                    self.write_part(at, &place, PART_LEN)?;
                }
            }
        }
        if new.is_none() && stored.is_some_and(|stored| stored.crc != !crc) {
            return Err(Error::NotAsWritten);
        }
        let changes = Changes { parts: changed, others: old.place::<F>() as u16 };
        Ok(Some(Reference { first, len, crc: !crc, changes: keeps_some.then_some(changes) }))
    }

    /// The address and the sequence number of the next place.
    fn take(&mut self) -> Result<(u32, u32), Error> {
        let place = self.space.take::<F>()?;
        if F::IS_WIDE {
            self.begin_wide(place.0)?;
        }
        Ok(place)
    }

    /// Writes a record to a blank place.
    fn write(&mut self, at: u32, bytes: &[u8; record::LEN as usize]) -> Result<(), Error> {
        let (whole, last) = bytes.split_at(record::LAST_AT);
        let (content, crc) = whole.split_at(record::CRC_AT);
        self.begin(at, content)?;
        // The read-backs decide, as at the next open, whatever the flash reports for the last two words.
        self.is_doubtful = true;
        let _ = self.flash.write(at.saturating_add(record::CRC_AT as u32), crc);
        let is_valid = read(&mut self.flash, at)?.starts_with(whole);
        if is_valid {
            let _ = self.flash.write(at.saturating_add(record::LAST_AT as u32), last);
        }
        let is_written = read(&mut self.flash, at)? == *bytes;
        self.is_doubtful = is_valid && !is_written;
        if is_written { Ok(()) } else { Err(Error::NotAsWritten) }
    }

    /// Writes a part of the parameters, or a mark, to a blank place; only the first `len` bytes of its data are
    /// written.
    fn write_part(
        &mut self,
        at: u32,
        bytes: &[u8; record::LEN as usize],
        len: usize,
    ) -> Result<(), Error> {
        const DATA_AT: usize = record::LEN as usize - record::LAST_AT;
        let (whole, last) = bytes.split_at(record::LAST_AT);
        let (sequence, data) = whole.split_at(DATA_AT);
        let data = data.get(..len).unwrap_or(data);
        self.begin(at, sequence)?;
        // The data may read as those of a record, unless the last word is complete before them.
        for (offset, words) in [(record::LAST_AT, last), (DATA_AT, data)] {
            let at = at.saturating_add(offset as u32);
            self.flash.write(at, words).map_err(|_| Error::Refused)?;
        }
        if read(&mut self.flash, at)? == *bytes { Ok(()) } else { Err(Error::NotAsWritten) }
    }

    /// Writes the beginning of a blank place and reads it back.
    fn begin(&mut self, at: u32, content: &[u8]) -> Result<(), Error> {
        if !is_blank(&read(&mut self.flash, at)?) {
            return Err(Error::NotBlank);
        }
        self.flash.write(at, content).map_err(|_| Error::Refused)?;
        let written = read(&mut self.flash, at)?;
        if written.starts_with(content) { Ok(()) } else { Err(Error::NotAsWritten) }
    }
}

/// The parameters of a record in the flash, read from the start to the end.
struct Blob<'a, F> {
    flash: &'a mut F,
    newest: Newest,
    /// The number of bytes before the next one to read.
    at: usize,
    /// The part that was read last, and its number.
    last: Option<(u16, [u8; PART_LEN])>,
}

impl<F: NorFlash> Blob<'_, F> {
    /// The number of bytes that have not been read.
    fn rest(&self) -> usize {
        let len = self.newest.record.parameters.map_or(0, |parameters| parameters.len);
        usize::from(len).saturating_sub(self.at)
    }

    fn skip(&mut self, bytes: usize) {
        self.at = self.at.saturating_add(bytes);
    }

    fn read(&mut self, mut to: &mut [u8]) -> Result<(), Error> {
        while !to.is_empty() {
            let number = (self.at / PART_LEN) as u16;
            let part = match self.last {
                Some((last, part)) if last == number => part,
                _ => self.newest.part(self.flash, number)?.ok_or(Error::NotAsWritten)?,
            };
            self.last = Some((number, part));
            let read = copy(&part, self.at % PART_LEN, to);
            self.skip(read);
            to = to.get_mut(read..).unwrap_or_default();
        }
        Ok(())
    }
}
