//! The chip's flash, sectors 1 and 2, for the settings log (RM0090, chapter 3).

use canopen_node::settings::parameters::capacity;
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash, check_erase, check_read,
    check_write,
};
use stm32f4xx_hal::pac;

use crate::{chip::SETTINGS, supply::Supply};

const FIRST_SECTOR: u32 = 1;
const SECTORS: u32 = 2;
const SECTOR_LEN: u32 = 16 * 1024;

/// The greatest number of bytes that stored parameters may take.
pub const CAPACITY: usize = capacity(SECTOR_LEN as usize, SettingsFlash::WRITE_SIZE);

/// The width of programming and erasing, as PSIZE has it (RM0090, 3.6.2).
#[derive(Clone, Copy)]
enum Width {
    /// From 1.8 V on.
    Byte = 0,
    /// From 2.7 V on.
    Word = 2,
}

/// The number of status reads after which programming is considered hung: it takes 100 us at most. Meanwhile the core
/// stalls when it fetches from the flash, but code in the instruction cache runs on.
const PROGRAM_READS: u32 = 10_000;
/// The same for the erase of a sector, 800 ms at most: a read takes at least 50 ns.
const ERASE_READS: u32 = 20_000_000;

/// FLASH_SR: the busy flag, and the errors of programming and erasing.
const BUSY: u32 = 1 << 16;
const ERRORS: u32 = 0b1111_0010;
const WRITE_PROTECTED: u32 = 1 << 4;

/// The part of the flash that holds the settings log.
pub struct SettingsFlash {
    registers: pac::FLASH,
    supply: Supply,
}

/// The reason for a failed operation.
#[derive(Debug)]
pub enum FlashError {
    /// The address or length is invalid.
    Range(NorFlashErrorKind),
    /// The operation ended, or did not end, with error bits in FLASH_SR (RM0090, 3.9.5).
    Status,
}

impl NorFlashError for FlashError {
    fn kind(&self) -> NorFlashErrorKind {
        match self {
            Self::Range(kind) => *kind,
            Self::Status => NorFlashErrorKind::Other,
        }
    }
}

impl SettingsFlash {
    /// Takes the flash controller; `supply` decides on the width of programming.
    pub fn new(registers: pac::FLASH, supply: Supply) -> Self {
        Self { registers, supply }
    }

    /// Runs `operation` with the width that the supply allows, with the control register unlocked and old errors
    /// cleared.
    fn operate(
        &mut self,
        operation: impl FnOnce(&Self, Width) -> Result<(), FlashError>,
    ) -> Result<(), FlashError> {
        let width = if self.supply.is_low() { Width::Byte } else { Width::Word };
        let flash = &self.registers;
        // What the data cache reads while the flash is busy may be wrong (ES0206, 2.2.12), and what it holds will be old.
        flash.acr().modify(|_, w| w.dcen().clear_bit());
        // SAFETY: the two keys, in this order, unlock FLASH_CR (RM0090, 3.6.1); error bits are cleared by writing 1.
        unsafe {
            if flash.cr().read().lock().bit_is_set() {
                flash.keyr().write(|w| w.key().bits(0x4567_0123));
                flash.keyr().write(|w| w.key().bits(0xCDEF_89AB));
            }
            flash.sr().write(|w| w.bits(ERRORS));
        }
        let outcome = operation(self, width);
        flash.cr().write(|w| w.lock().set_bit());
        flash.acr().modify(|_, w| w.dcrst().set_bit());
        flash.acr().modify(|_, w| w.dcrst().clear_bit());
        flash.acr().modify(|_, w| w.dcen().set_bit());
        outcome
    }

    fn wait(&self, reads: u32) -> Result<(), FlashError> {
        let mut status = BUSY;
        for _ in 0..reads {
            status = self.registers.sr().read().bits();
            if status & BUSY == 0 {
                break;
            }
        }
        let status = status & (BUSY | ERRORS);
        if status == 0 {
            return Ok(());
        }
        if status & WRITE_PROTECTED != 0 {
            defmt::error!(
                "flash: not written, the sector is write-protected; clear its protection in the option bytes"
            );
        } else {
            defmt::error!("flash: the operation failed with FLASH_SR {=u32:#x}", status);
        }
        Err(FlashError::Status)
    }
}

impl ErrorType for SettingsFlash {
    type Error = FlashError;
}

impl ReadNorFlash for SettingsFlash {
    const READ_SIZE: usize = 4;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), FlashError> {
        check_read(self, offset, bytes.len()).map_err(FlashError::Range)?;
        let (words, _) = bytes.as_chunks_mut();
        let from = SETTINGS.wrapping_byte_add(offset as usize);
        for (i, word) in words.iter_mut().enumerate() {
            // SAFETY: an aligned word within the sectors; volatile, since the hardware changes them.
            *word = unsafe { from.add(i).read_volatile() }.to_le_bytes();
        }
        Ok(())
    }

    fn capacity(&self) -> usize {
        (SECTORS * SECTOR_LEN) as usize
    }
}

impl NorFlash for SettingsFlash {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = SECTOR_LEN as usize;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), FlashError> {
        check_erase(self, from, to).map_err(FlashError::Range)?;
        self.operate(|flash, width| {
            for sector in from / SECTOR_LEN..to / SECTOR_LEN {
                let number = (FIRST_SECTOR + sector) as u8;
                // SAFETY: the number of one of our sectors, and a width that the supply allows.
                flash.registers.cr().write(|w| unsafe {
                    w.lock()
                        .clear_bit()
                        .psize()
                        .bits(width as u8)
                        .ser()
                        .set_bit()
                        .snb()
                        .bits(number)
                        .strt()
                        .set_bit()
                });
                flash.wait(ERASE_READS)?;
            }
            Ok(())
        })
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), FlashError> {
        check_write(self, offset, bytes.len()).map_err(FlashError::Range)?;
        self.operate(|flash, width| {
            // SAFETY: a width that the supply allows.
            flash.registers.cr().write(|w| unsafe {
                w.lock().clear_bit().psize().bits(width as u8).pg().set_bit()
            });
            let to = SETTINGS.wrapping_byte_add(offset as usize);
            match width {
                Width::Byte => {
                    for (i, byte) in bytes.iter().enumerate() {
                        // SAFETY: a byte within the sectors; the store programs it.
                        unsafe { to.cast::<u8>().add(i).write_volatile(*byte) };
                        flash.wait(PROGRAM_READS)?;
                    }
                }
                Width::Word => {
                    let (words, _) = bytes.as_chunks();
                    for (i, word) in words.iter().enumerate() {
                        // SAFETY: an aligned word within the sectors; the store programs it.
                        unsafe { to.add(i).write_volatile(u32::from_le_bytes(*word)) };
                        flash.wait(PROGRAM_READS)?;
                    }
                }
            }
            Ok(())
        })
    }
}
