//! The flash with the places of programs, RUN and BACKUP (RM0090, chapter 3).

use core::sync::atomic::{AtomicPtr, AtomicU32, AtomicUsize, Ordering::Relaxed};

use cortex_m::{asm, interrupt};
use program_update::{Area, Flash, FlashError, ROW, crc};
use stm32f4xx_hal::pac::{CRC, FLASH, RCC};

use crate::{chip::RUN, supply::Supply};

const KB: u32 = 1024;
const COUNT: usize = RUN.sectors as usize;
const BACKUP_SECTORS: [u32; COUNT] = [128 * KB; COUNT];
const RUN_SECTORS: [u32; COUNT] = {
    let mut sectors = BACKUP_SECTORS;
    // Sector 4.
    sectors[0] = RUN.kb * KB - (RUN.sectors - 1) * 128 * KB;
    sectors
};

/// FLASH_SR: the end of an operation, busy, and the errors.
const EOP: u32 = 1 << 0;
const BUSY: u32 = 1 << 16;
const ERRORS: u32 = 0b1111_0010;
const WRITE_PROTECTED: u32 = 1 << 4;
/// FLASH_CR: programming, erase of a sector, width of a half-word and of a word, start, interrupt at the end, lock.
const PG: u32 = 1 << 0;
const SER: u32 = 1 << 1;
const HALF_WORD: u32 = 1 << 8;
const WORD: u32 = 2 << 8;
const STRT: u32 = 1 << 16;
const EOPIE: u32 = 1 << 24;
const LOCK: u32 = 1 << 31;

/// The time in us after which an operation counts as hung: a row takes 4 ms at most, a sector of 128 KB 3 s.
const ROW_LIMIT: u32 = 10_000;
const ERASE_LIMIT: u32 = 4_000_000;

/// The words of a row that are still to be programmed. They stand at the end.
static WORDS: [AtomicU32; ROW] = [const { AtomicU32::new(0) }; ROW];
/// The number of their half-words.
static LEFT: AtomicUsize = AtomicUsize::new(0);
/// The place of the first of them.
static NEXT: AtomicPtr<u16> = AtomicPtr::new(core::ptr::null_mut());

/// The flash with both areas.
pub struct Areas {
    /// A count of at least a microsecond.
    now: fn() -> u32,
    /// The start of the operation under way and its limit.
    operation: Option<(u32, u32)>,
    /// The data cache was on before it.
    was_cached: bool,
}

impl Areas {
    pub const fn new(now: fn() -> u32) -> Self {
        Self { now, operation: None, was_cached: false }
    }

    fn registers() -> &'static stm32f4xx_hal::pac::flash::RegisterBlock {
        // SAFETY: one owner at a time uses them: the loader, or in the program the task that stores.
        unsafe { &*FLASH::ptr() }
    }

    /// Whether an operation is under way.
    pub fn is_busy() -> bool {
        Self::registers().sr().read().bits() & BUSY != 0
    }

    /// Handles the interrupt at the end of an operation: starts to program the next word or half-word of the row.
    pub fn go_on() {
        let flash = Self::registers();
        // SAFETY: a 1 clears the flag.
        flash.sr().write(|w| unsafe { w.bits(EOP) });
        let left = LEFT.load(Relaxed);
        let Some(word) = WORDS.get(ROW.wrapping_sub(left.div_ceil(2))) else { return };
        if flash.sr().read().bits() & (BUSY | ERRORS) != 0 {
            return;
        }
        let (word, place) = (word.load(Relaxed), NEXT.load(Relaxed));
        // SAFETY: the library programs words of the areas. FLASH_CR says how wide the stores are, and does not change.
        let programmed = unsafe {
            if flash.cr().read().bits() & WORD != 0 {
                place.cast::<u32>().write_volatile(word);
                2
            } else {
                place.write_volatile((word >> (16 * (left % 2))) as u16);
                1
            }
        };
        // The flash is busy before the count says so.
        asm::dsb();
        NEXT.store(place.wrapping_add(programmed), Relaxed);
        LEFT.store(left.wrapping_sub(programmed), Relaxed);
    }

    fn begin(&mut self, control: u32, limit: u32) -> Result<(), FlashError> {
        // SAFETY: no interrupt uses the detector.
        let supply = unsafe { Supply::steal() };
        let width = match supply.is_low() {
            false => WORD,
            true if supply.is_very_low() => return Err(FlashError::SupplyLow),
            true => HALF_WORD,
        };
        let flash = Self::registers();
        self.was_cached = flash.acr().read().dcen().bit_is_set();
        // What the cache reads while the flash is busy may be wrong (ES0206, 2.2.12).
        flash.acr().modify(|_, w| w.dcen().clear_bit());
        // SAFETY: the two keys unlock FLASH_CR (RM0090, 3.6.1); a 1 clears an error; the operation is one of this driver.
        unsafe {
            if flash.cr().read().lock().bit_is_set() {
                flash.keyr().write(|w| w.key().bits(0x4567_0123));
                flash.keyr().write(|w| w.key().bits(0xCDEF_89AB));
            }
            flash.sr().write(|w| w.bits(ERRORS | EOP));
            flash.cr().write(|w| w.bits(control | width | EOPIE));
        }
        self.operation = Some(((self.now)(), limit));
        Ok(())
    }

    fn address(area: Area, offset: u32) -> *mut u32 {
        let base = match area {
            Area::Run => RUN.address,
            Area::Backup => RUN.address + RUN.kb * KB,
        };
        (base + offset) as *mut u32
    }
}

impl Flash for Areas {
    fn sectors(&self, area: Area) -> &'static [u32] {
        match area {
            Area::Run => &RUN_SECTORS,
            Area::Backup => &BACKUP_SECTORS,
        }
    }

    fn read(&mut self, area: Area, offset: u32) -> u32 {
        // SAFETY: the library reads words of the areas.
        unsafe { Self::address(area, offset).read_volatile() }
    }

    fn program(&mut self, area: Area, offset: u32, words: &[u32]) -> Result<(), FlashError> {
        if words.is_empty() {
            return Ok(());
        }
        self.begin(PG, ROW_LIMIT)?;
        for (to, word) in WORDS.iter().rev().zip(words.iter().rev()) {
            to.store(*word, Relaxed);
        }
        NEXT.store(Self::address(area, offset).cast(), Relaxed);
        LEFT.store(2 * words.len(), Relaxed);
        interrupt::free(|_| Self::go_on());
        Ok(())
    }

    fn erase(&mut self, area: Area, sector: usize) -> Result<(), FlashError> {
        let first = if area == Area::Run { 0 } else { RUN.sectors };
        let number = RUN.first_sector + first + sector as u32;
        self.begin(SER | number << 3 | STRT, ERASE_LIMIT)
    }

    fn poll(&mut self) -> Option<Result<(), FlashError>> {
        let (since, limit) = self.operation?;
        let flash = Self::registers();
        // In this order: between the two the interrupt may start the last word.
        let left = LEFT.load(Relaxed);
        let status = flash.sr().read().bits();
        let is_over = status & BUSY == 0 && (left == 0 || status & ERRORS != 0);
        if !is_over && (self.now)().wrapping_sub(since) < limit {
            // Only the loader has the interrupt, not what runs before it, nor the program.
            if left > 0 {
                interrupt::free(|_| Self::go_on());
            }
            return None;
        }
        self.operation = None;
        LEFT.store(0, Relaxed);
        // SAFETY: the lock has no other effect.
        flash.cr().write(|w| unsafe { w.bits(LOCK) });
        if self.was_cached {
            // The data cache may hold old content.
            flash.acr().modify(|_, w| w.dcrst().set_bit());
            flash.acr().modify(|_, w| w.dcrst().clear_bit());
            flash.acr().modify(|_, w| w.dcen().set_bit());
        }
        Some(match status & ERRORS {
            0 if is_over => Ok(()),
            errors if errors & WRITE_PROTECTED != 0 => Err(FlashError::Protected),
            _ => Err(FlashError::Failed),
        })
    }

    fn crc(&mut self, area: Area, offset: u32, words: u32, so_far: u32) -> u32 {
        // SAFETY: the unit and its clock have no other user.
        let (clocks, unit) = unsafe { (&*RCC::ptr(), &*CRC::ptr()) };
        if so_far == crc::BEGIN {
            clocks.ahb1enr().modify(|_, w| w.crcen().set_bit());
            // The unit may miss a write right after that (errata sheets, "delay after an RCC peripheral clock enabling").
            asm::dsb();
            unit.cr().write(|w| w.reset().set_bit());
        }
        for word in 0..words {
            let word = self.read(area, offset + 4 * word);
            // SAFETY: any word is one.
            unit.dr().write(|w| unsafe { w.bits(word.reverse_bits()) });
        }
        unit.dr().read().bits().reverse_bits()
    }
}
