//! The flash with the two areas, as the board's driver offers it.

use crate::crc;

/// The most words that [`Flash::program`] takes at once.
pub const ROW: usize = 16;

/// One of the two places of a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Area {
    /// The program runs here.
    Run,
    /// The copy of the program before, and the journal.
    Backup,
}

/// The reason for a failed operation of the flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FlashError {
    /// It ended with an error, did not end, or reads back otherwise than written.
    Failed,
    /// The sector is write-protected.
    Protected,
    /// The supply is too low to write.
    SupplyLow,
}

/// The flash with the areas RUN and BACKUP.
///
/// Offsets are in bytes from the beginning of an area, multiples of four. The library starts an operation only after
/// [`poll`](Self::poll) has reported the end of the one before, and reads nothing meanwhile.
pub trait Flash {
    /// The lengths of the sectors of an area in bytes, in order. The first one is longer than the header (512 bytes);
    /// BACKUP is not shorter than RUN.
    fn sectors(&self, area: Area) -> &'static [u32];

    /// The word at an offset, as the flash holds it and no cache before it.
    fn read(&mut self, area: Area, offset: u32) -> u32;

    /// Starts to program words, [`ROW`] of them at most, one after the other from `offset` on. That clears bits only. A
    /// word may be programmed more than once between two erases. After a word that fails the others are left out.
    ///
    /// # Errors
    /// Nothing was started.
    fn program(&mut self, area: Area, offset: u32, words: &[u32]) -> Result<(), FlashError>;

    /// Starts to erase a sector, given by its number in [`sectors`](Self::sectors).
    ///
    /// # Errors
    /// Nothing was started.
    fn erase(&mut self, area: Area, sector: usize) -> Result<(), FlashError>;

    /// The end of the operation under way, once; `None` until then. The driver ends an operation that takes too long
    /// with [`FlashError::Failed`]: some callers wait.
    fn poll(&mut self) -> Option<Result<(), FlashError>>;

    /// Continues a CRC-32 over `words` words from `offset` on. It begins with [`crc::BEGIN`].
    ///
    /// A range is fed from its beginning to its end, with no other one in between, so that a CRC unit which cannot be
    /// set to a value may ignore all of `so_far` but [`crc::BEGIN`]. On an STM32F4: feed the unit the words with their
    /// bits reversed, and reverse the bits of what it holds.
    fn crc(&mut self, area: Area, offset: u32, words: u32, so_far: u32) -> u32 {
        (0..words).fold(so_far, |crc, i| {
            let word = self.read(area, offset.wrapping_add(4 * i));
            crc::more(crc, &word.to_le_bytes())
        })
    }
}

/// Programs a word, waits, and reads it back.
pub(crate) fn write<F: Flash>(
    flash: &mut F,
    area: Area,
    offset: u32,
    word: u32,
) -> Result<(), FlashError> {
    flash.program(area, offset, &[word])?;
    loop {
        if let Some(outcome) = flash.poll() {
            outcome?;
            break;
        }
    }
    if flash.read(area, offset) == word { Ok(()) } else { Err(FlashError::Failed) }
}
