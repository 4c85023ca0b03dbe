//! The flash interface as seen by a driver, and the state after failures.

use std::collections::BTreeSet;

use emulator::{
    Time,
    chip::{BusFault, ChipVariant, Part, PowerCut, Problem, Request, ResetCause, Timing, Width},
};

use crate::rig::{FLASH_ACR as ACR, RCC_AHB1ENR, Rig};

const KEYR: u32 = 0x4002_3C04;
const SR: u32 = 0x4002_3C0C;
const CR: u32 = 0x4002_3C10;
const OPTCR: u32 = 0x4002_3C14;

const BSY: u32 = 1 << 16;
const WRPERR: u32 = 1 << 4;
const PGPERR: u32 = 1 << 6;
const PGSERR: u32 = 1 << 7;
const X32: u32 = 2 << 8;
const PG: u32 = 1;
const SER: u32 = 2;
const STRT: u32 = 1 << 16;

fn unlocked(part: Part) -> Rig {
    let mut rig = Rig::new(part);
    rig.unlock();
    rig
}

impl Rig {
    fn unlock(&mut self) {
        self.write_all(&[(KEYR, 0x4567_0123), (KEYR, 0xCDEF_89AB)]);
    }

    /// The word in the flash.
    fn cells(&self, offset: usize) -> u32 {
        let bytes = &self.flash().bytes()[offset..offset + 4];
        u32::from_le_bytes(bytes.try_into().expect("four bytes"))
    }

    /// Waits for the end of an operation and returns how long it took.
    fn wait(&mut self) -> Time {
        let start = self.now;
        if let Some(end) = self.flash().operation_end() {
            assert_ne!(self.read(SR) & BSY, 0);
            self.now = end;
        }
        assert_eq!(self.read(SR) & BSY, 0);
        self.now - start
    }

    fn program(&mut self, offset: u32, value: u32) {
        self.write_all(&[(CR, X32 | PG), (0x0800_0000 + offset, value)]);
    }

    fn program_and_wait(&mut self, offset: u32, value: u32) {
        self.program(offset, value);
        self.wait();
    }

    fn erase_and_wait(&mut self, number: u32) {
        self.erase(number);
        self.wait();
    }

    fn erase(&mut self, number: u32) {
        self.write_all(&[(CR, X32 | SER | number << 3), (CR, X32 | SER | number << 3 | STRT)]);
    }
}

#[test]
fn programming_clears_bits_and_never_sets_them() {
    let mut rig = unlocked(Part::Stm32f405);
    rig.program(0x4000, 0x00FF_1234);
    assert!(rig.wait() >= Time::from_us(16));
    rig.program_and_wait(0x4000, 0xFF0F_FFF0);
    assert_eq!(rig.cells(0x4000), 0x000F_1230);
    assert_eq!(rig.read(SR), 0);
}

#[test]
fn an_erase_sets_its_sector_and_no_other() {
    let first_four = |part| {
        [0, 1, 2, 3]
            .map(|sector| (part, sector, 0x4000 * sector as usize..0x4000 * (sector as usize + 1)))
    };
    let others = [
        (Part::Stm32f405, 4, 0x1_0000..0x2_0000),
        (Part::Stm32f405, 11, 0xE_0000..0x10_0000),
        (Part::Stm32f413, 12, 0x10_0000..0x12_0000),
        (Part::Stm32f413, 15, 0x16_0000..0x18_0000),
        (Part::Stm32f446, 7, 0x6_0000..0x8_0000),
        (Part::Stm32f427, 16, 0x10_0000..0x10_4000),
        (Part::Stm32f427, 27, 0x1E_0000..0x20_0000),
        (Part::Stm32f469, 27, 0x1E_0000..0x20_0000),
    ];
    for (part, number, range) in Part::F4.into_iter().flat_map(first_four).chain(others) {
        let mut rig = unlocked(part);
        rig.flash_mut().load(0, &vec![0; part.flash_size() as usize]);
        rig.erase_and_wait(number);
        let mut expected = vec![0; part.flash_size() as usize];
        expected[range].fill(0xFF);
        assert!(rig.flash().bytes() == expected, "{part:?}, sector {number}");
    }
}

#[test]
fn times_follow_the_data_sheet() {
    for (part, timing, size, sector, ms) in [
        (Part::Stm32f405, Timing::Typical, 2, 1, 250),
        (Part::Stm32f405, Timing::Typical, 0, 1, 400),
        (Part::Stm32f405, Timing::Worst, 1, 1, 600),
        (Part::Stm32f405, Timing::Worst, 0, 1, 800),
        (Part::Stm32f413, Timing::Typical, 2, 5, 1_000),
        (Part::Stm32f413, Timing::Typical, 2, 12, 1_000),
        (Part::Stm32f413, Timing::Typical, 2, 15, 1_000),
    ] {
        let mut rig = unlocked(part);
        rig.flash_mut().set_timing(timing);
        rig.write(CR, size << 8 | SER | sector << 3 | STRT);
        assert_eq!(rig.wait().as_ms(), ms, "{part:?}, {timing:?}, sector {sector}");
    }
}

#[test]
fn a_store_without_pg_or_in_the_wrong_width_is_reported_and_does_nothing() {
    let mut rig = unlocked(Part::Stm32f405);
    rig.write(0x0800_4000, 0);
    assert_eq!((rig.read(SR), rig.cells(0x4000)), (PGSERR, u32::MAX));
    rig.write_all(&[(SR, PGSERR), (CR, X32 | PG)]);
    rig.store(0x0800_4000, Width::Byte, 0).expect("no bus error");
    assert_eq!((rig.read(SR), rig.cells(0x4000)), (PGPERR, u32::MAX));
    rig.write(SR, PGPERR);
    assert_eq!(rig.read(SR), 0);
}

#[test]
fn a_protected_sector_can_be_neither_programmed_nor_erased() {
    let mut rig = unlocked(Part::Stm32f405);
    rig.flash_mut().protect_sectors(1 << 2);
    assert_eq!(rig.read(OPTCR) >> 16, 0x0FFB);
    rig.program(0x8000, 0);
    assert_eq!(rig.read(SR), WRPERR);
    rig.write(SR, WRPERR);
    rig.erase(2);
    assert_eq!(rig.read(SR), WRPERR);
    rig.write(SR, WRPERR);
    rig.program_and_wait(0x4000, 0);
    assert_eq!((rig.cells(0x8000), rig.cells(0x4000)), (u32::MAX, 0));
}

#[test]
fn a_wrong_key_is_a_bus_error_and_locks_until_reset() {
    let mut rig = Rig::new(Part::Stm32f405);
    for key in [0x4567_0124, 0x4567_0123, 0xCDEF_89AB] {
        assert_eq!(rig.store(KEYR, Width::Word, key), Err(BusFault));
    }
    assert_eq!(rig.read(CR), 1 << 31);
    rig.reset_now(ResetCause::Software);
    rig.unlock();
    assert_eq!(rig.read(CR), 0);
}

#[test]
fn a_locked_control_register_keeps_its_value_and_the_write_is_found() {
    let mut rig = Rig::new(Part::Stm32f405);
    rig.write(CR, PG);
    assert_eq!(rig.read(CR), 1 << 31);
    assert_eq!(rig.findings().len(), 1);
}

#[test]
fn a_write_that_locks_starts_nothing_and_is_found() {
    let mut rig = unlocked(Part::Stm32f405);
    rig.write(CR, 1 << 31 | X32 | SER | 1 << 3 | STRT);
    assert_eq!(rig.read(CR), 1 << 31);
    assert_eq!((rig.flash().operations(), rig.findings().len()), (0, 1));
}

#[test]
fn an_erase_behind_the_data_cache_is_found_unless_the_cache_is_reset() {
    const DCEN: u32 = 1 << 10;
    const DCRST: u32 = 1 << 12;
    for reset in [false, true] {
        let mut rig = unlocked(Part::Stm32f405);
        rig.write(ACR, DCEN);
        rig.erase_and_wait(1);
        rig.write(CR, 1 << 31);
        if reset {
            rig.write_all(&[(ACR, 0), (ACR, DCRST), (ACR, 0), (ACR, DCEN)]);
        }
        rig.write(RCC_AHB1ENR, 1);
        let cached = Problem::Misuse("the data cache is on while the flash programs or erases");
        let stale = Problem::Misuse("the data cache holds what was erased: no DCRST since");
        assert_eq!(rig.problems(), if reset { vec![cached] } else { vec![cached, stale] });
    }
}

#[test]
fn a_word_that_is_programmed_with_the_data_cache_on_is_found() {
    for (acr, count) in [(0, 0), (1 << 10, 1)] {
        let mut rig = unlocked(Part::Stm32f405);
        rig.write(ACR, acr);
        rig.program_and_wait(0x4000, 0);
        assert_eq!(rig.findings().len(), count);
    }
}

#[test]
fn only_the_bank_that_works_stalls_its_readers() {
    let mut rig = unlocked(Part::Stm32f427);
    rig.erase(16);
    let now = rig.now;
    assert_eq!(rig.stalled_until(0x0800_C000, now), None);
    assert!(rig.stalled_until(0x0810_0000, now).is_some());
    assert_eq!(rig.stalled_until(0x2000_0000, now), None);
}

#[test]
fn a_power_cut_leaves_a_word_between_its_old_and_its_new_value() {
    let mut torn = 0;
    for seed in 0..200 {
        let mut rig = unlocked(Part::Stm32f405);
        rig.flash_mut().cut_power(PowerCut { operation: 1, seed });
        rig.program_and_wait(0x4000, 0x1234_5678);
        rig.program(0x4004, 0x0F0F_0000);
        let cut = rig.next_event();
        assert!(cut > rig.now && cut < rig.now + Time::from_us(17), "seed {seed}");
        assert_eq!(rig.advance(cut), Some(Request::PowerCut), "seed {seed}");
        rig.reset(ResetCause::PowerOn, cut);
        assert_eq!(rig.cells(0x4000), 0x1234_5678, "seed {seed}");
        let word = rig.cells(0x4004);
        assert_eq!(word & 0x0F0F_0000, 0x0F0F_0000, "seed {seed}");
        torn += u32::from(word != 0x0F0F_0000 && word != u32::MAX);
        assert_eq!(rig.next_event(), Time::MAX, "seed {seed}");
    }
    assert!(torn > 150, "{torn} of 200 words were torn");
}

#[test]
fn a_power_cut_in_an_erase_leaves_any_state_but_spares_other_sectors() {
    for seed in 0..20 {
        let mut rig = unlocked(Part::Stm32f405);
        let flash = rig.flash_mut();
        flash.load(0, &[0x5A; 0xC000]);
        flash.cut_power(PowerCut { operation: 0, seed });
        rig.erase(1);
        let cut = rig.next_event();
        rig.reset(ResetCause::PowerOn, cut);
        let bytes = rig.flash().bytes();
        assert!(bytes[..0x4000].iter().all(|&byte| byte == 0x5A), "seed {seed}");
        assert!(bytes[0x8000..0xC000].iter().all(|&byte| byte == 0x5A), "seed {seed}");
        let sector = &bytes[0x4000..0x8000];
        assert!(sector.contains(&0xFF) && sector.contains(&0x5A), "seed {seed}");
        assert!(sector.iter().any(|byte| ![0xFF, 0x5A].contains(byte)), "seed {seed}");
    }
}

#[test]
fn a_word_that_was_cut_flips_until_it_is_programmed_again() {
    let variant = ChipVariant { cut_words_flip: true, ..ChipVariant::default() };
    let mut rig = Rig::with_variant(Part::Stm32f405, variant);
    rig.unlock();
    rig.flash_mut().cut_power(PowerCut { operation: 0, seed: 100 });
    rig.program(0x4000, 0x1234_5678);
    let mut seen = BTreeSet::new();
    for _ in 0..50 {
        rig.reset_now(ResetCause::PowerOn);
        let word = rig.cells(0x4000);
        assert_eq!(word & 0x1234_5678, 0x1234_5678, "{word:#x}");
        seen.insert(word);
    }
    assert!(
        seen.len() > 10 && seen.contains(&0x1234_5678) && seen.contains(&u32::MAX),
        "{seen:x?}"
    );
    rig.unlock();
    rig.program_and_wait(0x4000, 0x1234_5678);
    for _ in 0..20 {
        rig.reset_now(ResetCause::PowerOn);
        assert_eq!(rig.cells(0x4000), 0x1234_5678);
    }
}

#[test]
fn words_below_2_7_v_and_double_words_without_vpp_are_found() {
    let finds = |mv: u32, psize: u32| {
        let mut rig = unlocked(Part::Stm32f405);
        rig.set_supply(mv);
        rig.write(CR, psize << 8 | PG);
        let width = [Width::Byte, Width::Half, Width::Word, Width::Word][psize as usize];
        rig.store(0x0800_4000, width, 0).expect("no bus error");
        rig.findings().len()
    };
    let cases = [(3_300, 2, 0), (2_700, 2, 0), (2_699, 2, 1), (2_699, 1, 0), (2_000, 1, 1)];
    for (mv, psize, findings) in cases.into_iter().chain([(1_800, 0, 0), (3_300, 3, 1)]) {
        assert_eq!(finds(mv, psize), findings, "{mv} mV, PSIZE {psize}");
    }
}
