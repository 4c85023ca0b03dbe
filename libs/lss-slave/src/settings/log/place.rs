//! A place of the log, of any program unit: how it is written and read.

use core::ops::Range;

use embedded_storage::nor_flash::NorFlash;

use super::Error;
use crate::{
    bytes::copy,
    settings::record::{self, LEN},
};

/// The number of places at the end of a bank that only starts use.
pub const RESERVE: u32 = 8;
/// The greatest program unit.
const MOST_UNIT: usize = 32;

/// The number of bytes before and after the 32 bytes of a place: a program unit, and at least a word.
const fn frame(write_size: usize) -> usize {
    if write_size > 4 { write_size } else { 4 }
}

/// The number of bytes that a place takes where the program unit has this many.
pub const fn len(write_size: usize) -> u32 {
    (LEN + 2 * frame(write_size)) as u32
}

/// The layout of places in a flash.
pub trait Layout: NorFlash {
    /// The number of bytes before and after the 32 bytes of a place.
    const FRAME: usize = frame(Self::WRITE_SIZE);
    /// The number of bytes that a place takes.
    const PLACE: u32 = len(Self::WRITE_SIZE);
    /// The flash is one of those for which the log is made.
    const IS_POSSIBLE: () = {
        assert!(
            matches!(Self::WRITE_SIZE, 1 | 2 | 4 | 8 | 16 | 32),
            "the program unit must be 1, 2, 4, 8, 16 or 32 bytes"
        );
        assert!(
            Self::FRAME.is_multiple_of(Self::READ_SIZE),
            "the read unit must divide the program unit, or a word if that is larger"
        );
        assert!(
            Self::ERASE_SIZE.is_multiple_of(MOST_UNIT),
            "the erase unit must be a multiple of 32 bytes"
        );
    };
}

impl<F: NorFlash> Layout for F {}

/// The places in a bank that have not been written.
pub struct Space {
    pub range: Range<u32>,
    /// The sequence number of the first of them.
    pub sequence: u32,
    /// The first address of the bank.
    pub bank: u32,
}

impl Space {
    pub const NONE: Self = Self { range: 0..0, sequence: 0, bank: 0 };

    /// The number of places.
    pub fn len<F: Layout>(&self) -> u32 {
        self.range.end.saturating_sub(self.range.start) / F::PLACE
    }

    /// The address and the sequence number of the next place.
    pub fn take<F: Layout>(&mut self) -> Result<(u32, u32), Error> {
        if self.len::<F>() == 0 {
            return Err(Error::Full);
        }
        let place = (self.range.start, self.sequence);
        self.range.start = self.range.start.saturating_add(F::PLACE);
        self.sequence = self.sequence.wrapping_add(1);
        Ok(place)
    }

    /// Leaves the last places to starts.
    pub fn keep_reserve<F: Layout>(&mut self) {
        self.range.end = self.range.end.saturating_sub(RESERVE.saturating_mul(F::PLACE));
    }
}

/// Reads whole units, and once more if that fails: if it fails again, a unit is torn.
fn read<F: NorFlash>(flash: &mut F, at: u32, to: &mut [u8]) -> Result<(), Error> {
    flash.read(at, to).or_else(|_| flash.read(at, to)).map_err(|_| Error::Refused)
}

/// The 32 bytes of a place.
pub fn content<F: Layout>(flash: &mut F, at: u32) -> Result<[u8; LEN], Error> {
    bytes(flash, at.saturating_add(F::FRAME as u32))
}

/// The 32 bytes at a unit.
pub fn bytes<F: Layout>(flash: &mut F, at: u32) -> Result<[u8; LEN], Error> {
    let mut bytes = [0; LEN];
    read(flash, at, &mut bytes)?;
    Ok(bytes)
}

/// Whether nothing was written to a place, as far as can be read.
pub fn is_blank<F: Layout>(flash: &mut F, at: u32) -> Result<bool, Error> {
    let mut place = [0; len(MOST_UNIT) as usize];
    let place = place.get_mut(..F::PLACE as usize).unwrap_or_default();
    read(flash, at, place)?;
    Ok(reads_blank(place))
}

/// Whether these words are blank. Not generic, so that a build for tests optimises it. By words, since a start asks this
/// of every place.
fn reads_blank(place: &[u8]) -> bool {
    place.chunks_exact(4).all(|word| word == [0xFF; 4])
}

/// Begins a place that reads blank.
pub fn begin<F: Layout>(flash: &mut F, at: u32) -> Result<(), Error> {
    let zeros = [0; MOST_UNIT];
    let zeros = zeros.get(..F::FRAME).unwrap_or_default();
    if is_blank(flash, at)? {
        flash.write(at, zeros).map_err(|_| Error::Refused)?;
        if !is_blank(flash, at)? {
            return Ok(());
        }
    }
    Err(Error::NotBlank)
}

/// Writes the 32 bytes of a place that is begun. Returns whether they could be read back.
pub fn write<F: Layout>(flash: &mut F, at: u32, bytes: &[u8; LEN]) -> Result<bool, Error> {
    flash.write(at.saturating_add(F::FRAME as u32), bytes).map_err(|_| Error::Refused)?;
    match content(flash, at) {
        Ok(read) if read != *bytes => Err(Error::NotAsWritten),
        outcome => Ok(outcome.is_ok()),
    }
}

/// What makes a record certain: its CRC and commit word once more.
fn commitment(bytes: &[u8; LEN]) -> [u8; MOST_UNIT] {
    let mut unit = [0xFF; MOST_UNIT];
    copy(bytes, record::CRC_AT, &mut unit);
    unit
}

const fn commitment_at<F: Layout>(at: u32) -> u32 {
    at.saturating_add(F::PLACE).saturating_sub(F::FRAME as u32)
}

/// Makes the record of these bytes at this place certain. Returns whether it is; `None` if that cannot be read.
pub fn commit<F: Layout>(flash: &mut F, at: u32, bytes: &[u8; LEN]) -> Option<bool> {
    let unit = commitment(bytes);
    let unit = unit.get(..F::FRAME).unwrap_or_default();
    if flash.write(commitment_at::<F>(at), unit).is_err() {
        return Some(false);
    }
    is_certain(flash, at, bytes).ok()
}

/// Whether the record of these bytes at this place is certain.
pub fn is_certain<F: Layout>(flash: &mut F, at: u32, bytes: &[u8; LEN]) -> Result<bool, Error> {
    let mut unit = [0; MOST_UNIT];
    let unit = unit.get_mut(..F::FRAME).unwrap_or_default();
    read(flash, commitment_at::<F>(at), unit)?;
    Ok(commitment(bytes).starts_with(unit))
}
