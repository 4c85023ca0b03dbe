//! The settings log: records appended to one of two banks of flash. The newest valid record holds the settings, and
//! refers to the parameters, which were written before it.
//!
//! # The promise
//! Whenever the power fails, the next [`Log::open`] finds the settings and parameters of the last [`Log::store`] that
//! returned `Ok`, or those of a later one that did not return; never older ones, never a mix. The result of an `open`
//! holds until the next store. A store that returns an error left what was stored. An operation that fails counts as a
//! power cut for all of this. Only if the flash dies in the very unit that makes a record valid or certain, and leaves
//! it torn, the result of the store is what the unit read then.
//!
//! A unit whose writing was interrupted may read as blank, as written, as anything, or not at all, and differently each
//! time. So may each unit of a bank whose erase was interrupted, and whatever such a bank reads must not count: what
//! makes it count lies in the other bank, written before the erase.
//!
//! # A bank
//! It fills from its first place on: here by the first start of a device, a store with parameters of two parts, and a
//! store by LSS.
//!
//! ```text
//! place
//! 0         a record without settings: the other bank is used
//! 1         the same: the other bank is erased
//! 2         part 0 of the parameters
//! 3         part 1 of the parameters
//! 4         a record with settings, and a reference to places 2 and 3
//! 5         the newest record, which counts, with the same reference
//! 6..400    blank
//! 401..408  blank: only starts use them
//! ```
//!
//! # A place
//! - A program unit of zeros begins it, or a word where units are smaller. It is the only part that may have been torn
//!   although it reads blank. If it is written once more, then with the same value; if the flash refuses that, or the
//!   place is not blank, the log passes over the place.
//! - The 32 bytes of a record or of a part of the parameters. The last unit of a record holds its commit word, and
//!   makes it valid.
//! - After a record is read back, a unit that repeats its CRC and commit word. A record with that unit is certain: the
//!   32 bytes read the same at every start.
//!
//! # Rules
//! - A record has a greater sequence number than all that its writer could read in both banks. The bank with the later
//!   certain record counts, and in it the last valid record.
//! - A record says how the [other bank](OtherBank) is. It says "erased" only if an erase was completed, and this holds
//!   until a later record in the same bank says otherwise.
//! - A flash with a record of another [layout](record) is only read. Before an erase, a start looks for one everywhere.
//! - A bank is erased only by `open`, never by `store`: an erase stops the CPU for up to 800 ms, which a node on the
//!   bus cannot afford.
//! - Before an erase, the same start appends the newest record as "used", and makes it certain. So whatever a half-erased
//!   bank reads, a certain record in this bank is later than all that could ever be certain in the other one. Records
//!   that were never made certain do not read so.
//! - Only starts use the last [places](place::RESERVE) of a bank, and a start that is complete leaves them blank. If
//!   only these are left after an erase, the log moves to the other bank. The first of them also takes back a store
//!   that failed in the place before it.

mod newest;
pub(super) mod place;
mod start;

use core::{error, fmt, mem};

use embedded_storage::nor_flash::NorFlash;

use super::{
    Settings,
    parameters::{self, HEADER, Parameter},
    record::{self, OtherBank, PART_LEN, Record, Reference},
};
use crate::bytes::copy;
use newest::{Blob, Newest, part_of, parts};
use place::{Layout, Space};

/// The number of places in a row that are passed over.
const MOST_TORN: u32 = 4;

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
    /// The flash held other data and no record; it is now formatted.
    OtherData,
    /// No record was valid, though there were some; the flash is now formatted and the device's defaults apply.
    Damaged,
    /// There are records of another layout, which another version of the program has written: they stay, and nothing is
    /// stored. The newest record of this layout applies, else the device's defaults.
    OtherLayout,
    /// The newest record is valid, but the parameters to which it refers are damaged; their defaults apply.
    ParametersDamaged,
    /// The flash could not be read, erased or written. The settings that were found apply, but storing may fail, and a
    /// later `open` may find those of a store that was interrupted.
    MediumFailed(Error),
}

/// The reason why an append stopped.
enum Stop {
    /// A place could not be begun.
    Torn(Error),
    Failed(Error),
}

impl From<Error> for Stop {
    fn from(error: Error) -> Self {
        Self::Failed(error)
    }
}

/// The settings log, on a flash that holds nothing else.
///
/// The flash is used as two banks of equal size, each a multiple of the erase size; a bank of 16 KB has room for 401
/// records, or for 333, 248 or 162 where the program unit has 8, 16 or 32 bytes. A store that finds no room in one bank
/// continues in the other, which the `open` before has erased.
///
/// Another program unit, or an erase unit that is no multiple of 32 bytes, does not compile:
///
/// ```compile_fail,E0080
/// # use core::convert::Infallible;
/// # use embedded_storage::nor_flash::{ErrorType, NorFlash, ReadNorFlash};
/// struct Eeprom;
///
/// # impl ErrorType for Eeprom {
/// #     type Error = Infallible;
/// # }
/// # impl ReadNorFlash for Eeprom {
/// #     const READ_SIZE: usize = 1;
/// #     fn read(&mut self, _: u32, _: &mut [u8]) -> Result<(), Infallible> {
/// #         Ok(())
/// #     }
/// #     fn capacity(&self) -> usize {
/// #         1000
/// #     }
/// # }
/// impl NorFlash for Eeprom {
///     const WRITE_SIZE: usize = 4;
///     const ERASE_SIZE: usize = 100;
/// #   fn erase(&mut self, _: u32, _: u32) -> Result<(), Infallible> {
/// #       Ok(())
/// #   }
/// #   fn write(&mut self, _: u32, _: &[u8]) -> Result<(), Infallible> {
/// #       Ok(())
/// #   }
/// }
///
/// lss_slave::settings::Log::<_, 0>::open(Eeprom);
/// ```
///
/// `STORED_LEN` is the greatest number of bytes of the packed parameters. It must not exceed the
/// [`capacity`](parameters::capacity) of a bank: then a store finds the flash full.
pub struct Log<F, const STORED_LEN: usize = 0> {
    flash: F,
    newest: Newest,
    /// The parameters of the newest record that the node has taken, or those of the last store.
    taken: [u8; STORED_LEN],
    taken_len: usize,
    /// The sequence number of the last record, if the next open may find it in another state than the last look did.
    uncertain: Option<u32>,
    /// The bank with the newest record counts at every open: one in it is certain, and later than all in the other.
    counts: bool,
    /// The flash holds records of another layout, and nothing is written.
    is_foreign: bool,
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
    /// There are records of another layout, see [`Found::OtherLayout`].
    OtherLayout,
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
            Self::OtherLayout => {
                "the flash holds settings of another version: load that version, or erase them"
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
            Self::OtherLayout => defmt::write!(
                f,
                "the flash holds settings of another version: load that version, or erase them"
            ),
        }
    }
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
        let mut log = Self::unopened(flash);
        let found = log.find().unwrap_or_else(Found::MediumFailed);
        log.space.keep_reserve::<F>();
        log.other.keep_reserve::<F>();
        (log, found)
    }

    /// A log that knows nothing yet of its flash.
    fn unopened(flash: F) -> Self {
        const {
            let () = F::IS_POSSIBLE;
            assert!(STORED_LEN < u16::MAX as usize, "the parameters take too many bytes");
        }
        let other_is = OtherBank::Used;
        let record = Record { sequence: 0, settings: None, parameters: None, other_is };
        Self {
            flash,
            newest: Newest { record, at: 0, bank: 0 },
            taken: [0; STORED_LEN],
            taken_len: 0,
            uncertain: None,
            counts: false,
            is_foreign: false,
            space: Space::NONE,
            other: Space::NONE,
        }
    }

    /// The persistent settings, as [`open`](Log::open) finds them, for one who only reads.
    pub fn peek(flash: F) -> Option<Settings> {
        let (bank, _) = Self::unopened(flash).search();
        bank.counts().and_then(|newest| newest.record.settings)
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
        let mut blob = Blob::new(&mut self.flash, self.newest);
        self.taken_len = 0;
        while blob.rest() >= HEADER {
            let mut header = [0; HEADER];
            blob.read(&mut header)?;
            let value_len = usize::from(parameters::value_len(header)).min(blob.rest());
            let to = self.taken.get_mut(self.taken_len..).unwrap_or_default();
            // A longer one is none of this node's, whose parameters all fit.
            let Some(to) = to.get_mut(..HEADER.saturating_add(value_len)) else {
                blob.skip(value_len);
                continue;
            };
            let (to_header, value) = to.split_at_mut(HEADER.min(to.len()));
            copy(&header, 0, to_header);
            blob.read(value)?;
            if Parameter::first_of(to).is_some_and(|parameter| take(&parameter)) {
                self.taken_len = self.taken_len.saturating_add(to.len());
            }
        }
        Ok(())
    }

    /// The persistent parameters, packed.
    pub fn parameters(&self) -> &[u8] {
        self.taken.get(..self.taken_len).unwrap_or_default()
    }

    /// Makes `settings` persistent and keeps the parameters. Writes nothing if the settings already are, else one
    /// record, which takes 0.2 ms (1 ms at worst) on an STM32F4. Where one bank is full, the parameters are copied to
    /// the other before it.
    ///
    /// # Errors
    /// The record could not be written and read back, or the flash is full until the next `open`. The previous settings
    /// are still persistent.
    pub fn store(&mut self, settings: Settings) -> Result<(), Error> {
        if self.settings() == Some(settings) && self.uncertain.is_none() {
            return Ok(());
        }
        self.replace(settings, None)
    }

    /// Makes `settings` and these packed parameters persistent. Parameters that already are cost nothing; of others
    /// each 24 bytes take as long as a record, before the record itself.
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
        self.replace(settings, Some(parameters))?;
        self.taken_len = copy(parameters, 0, &mut self.taken);
        Ok(())
    }

    /// Closes the log and returns its flash.
    pub fn close(self) -> F {
        self.flash
    }

    /// Makes `settings` persistent, or else leaves the old ones so.
    fn replace(&mut self, settings: Settings, new: Option<&[u8]>) -> Result<(), Error> {
        if self.is_foreign {
            return Err(Error::OtherLayout);
        }
        let (before, other_is) = (self.uncertain, self.newest.record.other_is);
        let outcome = self.append(Some(settings), new, other_is).map(|_| ());
        let Some(uncertain) = self.uncertain.filter(|it| before != Some(*it)) else {
            return outcome;
        };
        // The refused record may read as valid at a later start. The old settings behind it win then.
        if self.space.len::<F>() == 0 {
            // The first of the places that are left to starts.
            self.space.range.end = self.space.range.end.saturating_add(F::PLACE);
        }
        let other_is = self.newest.record.other_is;
        if self.append(self.settings(), None, other_is).is_err()
            // The flash has failed. What the next open will find is found now.
            && let Some(found) = self.search().0.counts()
            && found.record.sequence == uncertain
        {
            self.newest = found;
            self.uncertain = None;
            return Ok(());
        }
        outcome
    }

    /// Appends a record with `new` parameters, or with those of the newest one, behind places that turn out to be torn
    /// and in the bank where there is room. Returns whether it is certain.
    fn append(
        &mut self,
        settings: Option<Settings>,
        new: Option<&[u8]>,
        other_is: OtherBank,
    ) -> Result<bool, Error> {
        let before = self.uncertain;
        let (mut torn, mut has_moved) = (0, false);
        let outcome = loop {
            match self.write(settings, new, other_is) {
                Err(Stop::Torn(_)) if torn < MOST_TORN => torn += 1,
                Err(Stop::Failed(Error::Full)) if !has_moved => {
                    mem::swap(&mut self.space, &mut self.other);
                    (torn, has_moved) = (0, true);
                }
                Err(Stop::Torn(error) | Stop::Failed(error)) => break Err(error),
                Ok(is_certain) => break Ok(is_certain),
            }
        };
        if has_moved && (outcome.is_ok() || self.uncertain != before) {
            // Where a record is uncertain, those that are later must follow.
            self.other = Space::NONE;
        } else if has_moved {
            mem::swap(&mut self.space, &mut self.other);
        }
        outcome
    }

    /// Writes a record, after its parameters if they are new, or if the newest record is in the other bank. Writes
    /// nothing if they do not fit.
    fn write(
        &mut self,
        settings: Option<Settings>,
        new: Option<&[u8]>,
        other_is: OtherBank,
    ) -> Result<bool, Stop> {
        let in_other = self.space.bank != self.newest.bank;
        let parameters = match new {
            None if !in_other => self.newest.record.parameters,
            _ => self.write_parameters(new)?,
        };
        let (at, sequence) = self.take()?;
        let other_is = if in_other { OtherBank::Used } else { other_is };
        let record = Record { sequence, settings, parameters, other_is };
        let bytes = record.to_bytes();
        // A unit that the flash could not write may read as written later.
        self.uncertain = Some(sequence);
        place::write(&mut self.flash, at, &bytes)?;
        let is_certain = place::commit(&mut self.flash, at, &bytes);
        // Within a bank that counts, the last valid record does.
        if is_certain == Some(false) && (in_other || !self.counts) {
            return Err(Error::NotAsWritten.into());
        }
        self.newest = Newest { record, at, bank: self.space.bank };
        self.counts = true;
        self.uncertain = None;
        Ok(is_certain == Some(true))
    }

    /// The address and the sequence number of the next place, which is begun.
    fn take(&mut self) -> Result<(u32, u32), Stop> {
        let place = self.space.take::<F>()?;
        place::begin(&mut self.flash, place.0).map_err(Stop::Torn)?;
        Ok(place)
    }

    /// Writes the parts of these parameters, or of those of the newest record.
    fn write_parameters(&mut self, new: Option<&[u8]>) -> Result<Option<Reference>, Stop> {
        let old = self.newest;
        let stored = old.record.parameters;
        let len = new.map_or(stored.map_or(0, |stored| stored.len), |new| new.len() as u16);
        if len == 0 {
            return Ok(None);
        }
        if usize::from(len).div_ceil(PART_LEN) as u32 >= self.space.len::<F>() {
            return Err(Error::Full.into());
        }
        let first = self.space.range.start.saturating_sub(self.space.bank) / F::PLACE;
        let first = first.try_into().map_err(|_| Error::Full)?;
        let mut crc = u32::MAX;
        for (number, len) in parts(len) {
            let part = match new {
                Some(new) => part_of(new, number),
                None => old.part(&mut self.flash, number)?,
            };
            crc = record::crc32_of_more(crc, part.get(..len).unwrap_or_default());
            let (at, sequence) = self.take()?;
            let place = record::part_to_bytes(sequence, number, &part);
            if !place::write(&mut self.flash, at, &place)? {
                return Err(Error::Refused.into());
            }
        }
        if new.is_none() && stored.is_some_and(|stored| stored.crc != !crc) {
            return Err(Error::NotAsWritten.into());
        }
        Ok(Some(Reference { first, len, crc: !crc }))
    }
}
