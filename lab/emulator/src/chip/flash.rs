//! The flash interface (RM0090 chapter 3, RM0440 chapter 3): keys, programming, erasing, timing and faults.

mod array;
mod double_word;
mod options;
mod staging;
mod timing;

use std::ops::Range;

use array::Kind;
pub use array::{Cells, Done, StuckBits};
use options::Options;
pub use staging::PowerCut;
pub use timing::Timing;

use super::{ChipVariant, Part, Problem, Width, part::Family, registers::Registers};
use crate::Time;

const ACR: u32 = 0x00;
const KEYR: u32 = 0x04;
const OPTKEYR: u32 = 0x08;
const CR: u32 = 0x10;
const OPTCR: u32 = 0x14;
const OPTCR1: u32 = 0x18;
/// Registers of an STM32G4 only, by offsets that an STM32F4 does not have.
const ECCR: u32 = 0x100;
const OPTR: u32 = 0x104;

const ACR_PRFTEN: u32 = 1 << 8;
const ACR_ICEN: u32 = 1 << 9;
const ACR_DCEN: u32 = 1 << 10;
const ACR_ICRST: u32 = 1 << 11;
const ACR_DCRST: u32 = 1 << 12;
const SR_EOP: u32 = 1 << 0;
const SR_WRPERR: u32 = 1 << 4;
const SR_PGPERR: u32 = 1 << 6;
const SR_PGSERR: u32 = 1 << 7;
const SR_BSY: u32 = 1 << 16;
const CR_PG: u32 = 1 << 0;
const CR_SER: u32 = 1 << 1;
/// MER and MER1.
const CR_MER: u32 = 1 << 2 | 1 << 15;
const CR_STRT: u32 = 1 << 16;
/// OPTSTRT and FSTPG of an STM32G4.
const CR_UNMODELLED: u32 = 1 << 17 | 1 << 18;
const CR_EOPIE: u32 = 1 << 24;
const CR_LOCK: u32 = 1 << 31;
/// The lock of the option bytes of an STM32G4, which is never opened.
const CR_OPTLOCK: u32 = 1 << 30;
const ECCR_ECCD: u32 = 1 << 31;
const ECCR_ADDRESS: u32 = 0x7_FFFF;
const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];

#[derive(Debug)]
struct Operation {
    end: Time,
    range: Range<usize>,
    before: Vec<u8>,
    kind: Kind,
}

#[derive(Debug)]
pub struct Flash {
    part: Part,
    array: Cells,
    options: Options,
    timing: Timing,
    supply_mv: u32,
    cut_words_flip: bool,
    acr: u32,
    sr: u32,
    cr: u32,
    /// FLASH_ECCR of an STM32G4.
    eccr: u32,
    /// The first of the two keys was written.
    is_half_open: bool,
    /// A wrong key has closed FLASH_CR until the next reset.
    is_jammed: bool,
    stale_data_cache: bool,
    /// The first word of a double word, with its offset.
    first_word: Option<(u32, u32)>,
    operation: Option<Operation>,
    operations: Vec<Range<Time>>,
    done: Vec<Done>,
    power_cut: Option<PowerCut>,
    power_cut_at: Option<Time>,
    /// The operation with which the failures begin.
    failing_from: u64,
    failing_erases: u32,
    failing_erase_seed: u64,
    failing_programs: u32,
    refused_programs: u32,
    changed: Option<Range<usize>>,
}

impl Flash {
    /// Offset of FLASH_SR.
    pub(super) const SR: u32 = 0x0C;

    /// Whether the register accepts writes of bytes and half-words; on an STM32F4 all but the keys do (RM0090 3.9).
    pub(super) fn takes_narrow_writes(&self, offset: u32) -> bool {
        self.part.family() == Family::F4 && !matches!(offset, KEYR | OPTKEYR)
    }

    /// The offset that the register of this offset has on an STM32F4, if it has one.
    fn register(&self, offset: u32) -> Option<u32> {
        match (self.part.family(), offset) {
            (Family::F4, ..ECCR) => Some(offset),
            (Family::G4, 0x00) => Some(ACR),
            (Family::G4, 0x08) => Some(KEYR),
            (Family::G4, 0x10) => Some(Self::SR),
            (Family::G4, 0x14) => Some(CR),
            (Family::G4, 0x18) => Some(ECCR),
            (Family::G4, 0x20) => Some(OPTR),
            _ => None,
        }
    }

    /// FLASH_ACR and FLASH_CR after a reset.
    fn after_reset(part: Part) -> (u32, u32) {
        match part.family() {
            Family::F4 => (0, CR_LOCK),
            Family::G4 => (ACR_ICEN | ACR_DCEN, CR_LOCK | CR_OPTLOCK),
        }
    }

    /// Erased flash after power-on.
    pub fn new(part: Part, variant: &ChipVariant) -> Self {
        let (acr, cr) = Self::after_reset(part);
        Self {
            part,
            array: Cells::new(part),
            options: Options::new(part),
            timing: variant.flash_timing,
            supply_mv: 3_300,
            cut_words_flip: variant.cut_words_flip,
            acr,
            sr: 0,
            cr,
            eccr: 0,
            is_half_open: false,
            is_jammed: false,
            stale_data_cache: false,
            first_word: None,
            operation: None,
            operations: Vec::new(),
            done: Vec::new(),
            power_cut: None,
            power_cut_at: None,
            failing_from: 0,
            failing_erases: 0,
            failing_erase_seed: 0,
            failing_programs: 0,
            refused_programs: 0,
            changed: Some(0..part.flash_size() as usize),
        }
    }

    /// The entire content.
    pub fn bytes(&self) -> &[u8] {
        self.array.bytes()
    }

    /// Sets the wait states and caches of the boot loader.
    pub(super) fn leave_loader(&mut self) {
        self.acr = ACR_ICEN | ACR_DCEN | 3;
    }

    /// Whether an STM32G4 starts the boot loader in ROM, with the pin BOOT0 high or low.
    pub(super) fn starts_loader(&self, is_pin_high: bool) -> bool {
        self.options.starts_loader(is_pin_high)
    }

    /// The offsets of the double words that have a double error, in order.
    pub fn double_errors(&self) -> impl Iterator<Item = u32> {
        self.array.double_errors()
    }

    /// Notes a read of the core: a double error sets ECCD (RM0440 3.3.4).
    pub fn note_read(&mut self, offset: u32, length: u32) {
        let read = (offset & !7)..offset + length;
        let word = self.double_errors().find(|word| read.contains(word));
        if let Some(word) = word {
            self.eccr = self.eccr & !ECCR_ADDRESS | ECCR_ECCD | word;
        }
    }

    /// The level of the non-maskable interrupt.
    pub(super) fn nmi(&self) -> bool {
        self.eccr & ECCR_ECCD != 0
    }

    pub(super) fn bor_lev(&self) -> u32 {
        self.options.bor_lev()
    }

    /// The range that changed since the last call, for the owner of a copy.
    pub fn take_changed(&mut self) -> Option<Range<usize>> {
        self.changed.take()
    }

    /// FLASH_ACR.
    pub fn access_control(&self) -> u32 {
        self.acr
    }

    pub fn latency(&self) -> u32 {
        self.acr & 0xF
    }

    pub(super) fn prefetches(&self) -> bool {
        self.part.family() == Family::F4 && self.acr & ACR_PRFTEN != 0
    }

    /// The time at which the bank that holds `offset` can be read again, if it is busy at `now`.
    pub fn busy_until(&self, offset: u32, now: Time) -> Option<Time> {
        let operation = self.operation.as_ref().filter(|operation| now < operation.end)?;
        let bank = |offset: u32| offset / self.part.flash_bank_size();
        let busy = bank(operation.range.start as u32)..=bank(operation.range.end as u32 - 1);
        busy.contains(&bank(offset)).then_some(operation.end)
    }

    /// Whether a driver has finished and locked the flash but left erased content in the data cache (RM0090 3.5.2).
    /// True only once per erase.
    pub fn take_stale_data_cache(&mut self) -> bool {
        let stale = self.stale_data_cache && self.cr & CR_LOCK != 0 && self.acr & ACR_DCEN != 0;
        self.stale_data_cache &= !stale;
        stale
    }

    /// The time of the staged power cut, once its operation has begun.
    pub fn power_cut_at(&self) -> Option<Time> {
        self.power_cut_at
    }

    pub fn operation_end(&self) -> Option<Time> {
        self.operation.as_ref().map(|operation| operation.end)
    }

    /// The level of interrupt 4, FLASH.
    pub fn irq(&self) -> bool {
        self.sr & SR_EOP != 0 && self.cr & CR_EOPIE != 0
    }

    pub fn advance(&mut self, now: Time) {
        if self.operation.take_if(|operation| now >= operation.end).is_some() {
            self.cr &= !CR_STRT;
            // RM0090 3.9.4: EOP is set only if its interrupt is enabled.
            if self.cr & CR_EOPIE != 0 {
                self.sr |= SR_EOP;
            }
        }
    }

    /// Handles the return of the supply: interrupted cells may read differently now.
    pub(super) fn power_on(&mut self) {
        for range in self.array.flip_marginal() {
            self.note_change(range);
        }
    }

    fn note_change(&mut self, range: Range<usize>) {
        self.changed = Some(match self.changed.take() {
            None => range,
            Some(old) => old.start.min(range.start)..old.end.max(range.end),
        });
    }

    fn write_acr(&mut self, value: u32) -> Result<(), Problem> {
        let resets = value & (ACR_ICRST | ACR_DCRST) & !self.acr;
        if resets & ACR_ICRST != 0 && self.acr & ACR_ICEN != 0
            || resets & ACR_DCRST != 0 && self.acr & ACR_DCEN != 0
        {
            return Err(Problem::Misuse("cache reset while the cache is on has no effect"));
        }
        if resets & ACR_DCRST != 0 {
            self.stale_data_cache = false;
        }
        self.acr = value & 0x1F0F;
        Ok(())
    }

    fn write_cr(&mut self, value: u32, now: Time) -> Result<(), Problem> {
        let locked = Self::after_reset(self.part).1;
        if self.cr & CR_LOCK != 0 {
            return match value {
                _ if value == locked => Ok(()),
                _ => Err(Problem::Misuse("FLASH_CR written while it is locked")),
            };
        }
        if self.operation.is_some() {
            return Err(Problem::Misuse("FLASH_CR written while BSY is set"));
        }
        if value & CR_LOCK != 0 {
            self.cr = locked;
            self.is_half_open = false;
            if value & (CR_PG | CR_SER | CR_MER | CR_STRT) != 0 {
                return Err(Problem::Misuse(
                    "FLASH_CR locked in the write that requests an operation",
                ));
            }
            return Ok(());
        }
        self.cr = value & 0x0301_FFFF | locked & CR_OPTLOCK;
        if self.part.family() == Family::G4 && value & CR_UNMODELLED != 0 {
            return Err(Problem::Unmodelled);
        }
        if value & CR_STRT != 0 {
            return self.start_erase(now);
        }
        Ok(())
    }

    /// Accepts a key; the second one unlocks FLASH_CR.
    fn write_key(&mut self, key: u32) -> Result<(), Problem> {
        if self.is_jammed || key != KEYS[usize::from(self.is_half_open)] {
            self.is_jammed = true;
            self.cr |= CR_LOCK;
            return Err(Problem::BusFault);
        }
        if self.is_half_open {
            self.cr &= !CR_LOCK;
        }
        self.is_half_open = !self.is_half_open;
        Ok(())
    }

    /// Whether the supply allows the width that PSIZE selects (RM0090 table 9).
    fn check_parallelism(&self) -> Result<(), Problem> {
        let least_mv = match self.cr >> 8 & 3 {
            0 => 1_700,
            1 => 2_100,
            2 => 2_700,
            _ => return Err(Problem::Misuse("x64 needs Vpp, which the board lacks")),
        };
        if self.supply_mv < least_mv {
            return Err(Problem::Misuse("the supply is too low for this PSIZE"));
        }
        Ok(())
    }

    fn start_erase(&mut self, now: Time) -> Result<(), Problem> {
        if self.cr & CR_MER != 0 {
            self.cr &= !CR_STRT;
            return Err(Problem::Unmodelled);
        }
        // SNB leaves four numbers out between the banks. PNB has seven bits.
        let is_paged = self.part.family() == Family::G4;
        let sector = match self.cr >> 3 & 0x1F {
            _ if is_paged => Some(self.cr >> 3 & 0x7F),
            12..16 if self.part.has_two_banks() => None,
            number @ 16.. if self.part.has_two_banks() => Some(number - 4),
            number => Some(number),
        };
        let chosen = sector.filter(|_| self.cr & (CR_PG | CR_SER) == CR_SER);
        let range = chosen.and_then(|sector| self.array.sector(sector));
        let (Some(sector), Some(range)) = (chosen, range) else {
            self.cr &= !CR_STRT;
            self.sr |= SR_PGSERR;
            return Err(Problem::Misuse("STRT without a valid choice of SER and SNB"));
        };
        if self.options.protects(sector) {
            self.cr &= !CR_STRT;
            self.sr |= SR_WRPERR;
            return Ok(());
        }
        let time = if is_paged {
            self.timing.erase_page()
        } else {
            self.timing.erase(self.array.place(sector).1, self.cr >> 8 & 3)
        };
        let before = self.array.bytes()[range.clone()].to_vec();
        self.array.erase(range.clone());
        if self.fails(self.failing_erases) {
            self.failing_erases -= 1;
            let seed = self.failing_erase_seed.wrapping_add(self.operations());
            self.array.tear_erase(range.start, &before, seed);
        }
        self.stale_data_cache = self.acr & ACR_DCEN != 0 || self.stale_data_cache;
        let end = now + time;
        self.begin(Operation { end, range, before, kind: Kind::Erase }, now);
        if is_paged {
            Ok(())
        } else {
            self.check_parallelism().and_then(|()| self.check_data_cache())
        }
    }

    /// Erratum "data cache might be corrupted during flash memory read-while-write operation" (ES0206 2.2.12).
    fn check_data_cache(&self) -> Result<(), Problem> {
        match self.acr & ACR_DCEN {
            0 => Ok(()),
            _ => Err(Problem::Misuse("the data cache is on while the flash programs or erases")),
        }
    }

    /// A store of the CPU to flash address `offset`: programs it or sets the appropriate error flag.
    pub fn program(
        &mut self,
        offset: u32,
        width: Width,
        value: u32,
        now: Time,
    ) -> Result<(), Problem> {
        self.advance(now);
        let now = self.operation.as_ref().map_or(now, |operation| operation.end);
        self.advance(now);
        if self.part.family() == Family::G4 {
            self.program_double_word(offset, width, value, now);
            return self.misuse_of_double_words();
        }
        let size = 1 << (self.cr >> 8 & 3);
        if self.fails(self.refused_programs) {
            self.refused_programs -= 1;
            self.sr |= SR_PGSERR;
        } else if self.cr & CR_PG == 0 || self.cr & (CR_LOCK | CR_SER | CR_MER) != 0 {
            self.sr |= SR_PGSERR;
        } else if width.bytes() != size {
            self.sr |= SR_PGPERR;
        } else if self.options.protects(self.array.sector_of(offset)) {
            self.sr |= SR_WRPERR;
        } else {
            let range = offset as usize..offset as usize + size as usize;
            let before = self.array.bytes()[range.clone()].to_vec();
            let mut programmed = value;
            if self.fails(self.failing_programs) {
                self.failing_programs -= 1;
                // The lowest bit to be cleared stays set.
                programmed |= !value & value.wrapping_add(1);
            }
            self.array.program(offset, &programmed.to_le_bytes()[..size as usize]);
            let end = now + self.timing.program();
            self.begin(Operation { end, range, before, kind: Kind::Program }, now);
        }
        if self.cr & CR_PG == 0 {
            return Ok(());
        }
        self.check_parallelism().and_then(|()| self.check_data_cache())
    }

    /// Whether the next operation fails, if this number of failures is staged.
    fn fails(&self, staged: u32) -> bool {
        staged > 0 && self.operations() >= self.failing_from
    }

    fn begin(&mut self, operation: Operation, now: Time) {
        if let Some(cut) = self.power_cut.filter(|cut| cut.operation == self.operations()) {
            let duration = operation.end - now;
            let part = Time::from_ps(duration.as_ps() / 256 * (cut.seed % 255 + 1));
            self.power_cut_at = Some(now + part);
        }
        self.operations.push(now..operation.end);
        self.done.push(self.array.done(operation.kind, operation.range.clone()));
        self.note_change(operation.range.clone());
        self.operation = Some(operation);
    }
}

impl Registers for Flash {
    /// An interrupted operation leaves torn cells.
    fn reset(&mut self, now: Time) {
        self.advance(now);
        if let Some(operation) = self.operation.take() {
            let seed = self.power_cut.map_or(self.operations(), |cut| cut.seed);
            let Operation { range, before, kind, .. } = &operation;
            self.array.tear(*kind, range.start, before, self.cut_words_flip, seed);
            self.note_change(operation.range);
        }
        if self.power_cut_at.take().is_some() {
            self.power_cut = None;
        }
        (self.acr, self.cr) = Self::after_reset(self.part);
        (self.sr, self.eccr) = (0, 0);
        (self.is_half_open, self.is_jammed) = (false, false);
        self.first_word = None;
        self.stale_data_cache = false;
    }

    fn read(&mut self, offset: u32, now: Time) -> Option<u32> {
        self.advance(now);
        let busy = if self.operation.is_some() { SR_BSY } else { 0 };
        match self.register(offset)? {
            ACR => Some(self.acr),
            KEYR | OPTKEYR => Some(0),
            Self::SR => Some(self.sr | busy),
            CR => Some(self.cr),
            ECCR => Some(self.eccr),
            OPTR => Some(self.options.optr()),
            OPTCR => Some(self.options.registers()[0]),
            OPTCR1 if self.part.has_two_banks() => Some(self.options.registers()[1]),
            _ => None,
        }
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Problem> {
        self.advance(now);
        match self.register(offset).ok_or(Problem::Unmodelled)? {
            ACR => return self.write_acr(value),
            KEYR => return self.write_key(value),
            Self::SR => self.sr &= !value,
            CR => return self.write_cr(value, now),
            // A 1 clears ECCD; single errors, and an interrupt for them, are not modelled.
            ECCR => self.eccr &= !(value & ECCR_ECCD),
            _ => return Err(Problem::Unmodelled),
        }
        Ok(())
    }
}
