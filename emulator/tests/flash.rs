//! The flash interface as seen by a driver, and the state after failures.

use std::collections::BTreeSet;

use emulator::{
    Time,
    can::Clock,
    chip::{
        Access, BusFault, Chip, ChipVariant, Part, PowerCut, Request, ResetCause, StuckBits,
        Timing, Width,
    },
};

const ACR: u32 = 0x4002_3C00;
const KEYR: u32 = 0x4002_3C04;
const OPTKEYR: u32 = 0x4002_3C08;
const SR: u32 = 0x4002_3C0C;
const CR: u32 = 0x4002_3C10;
const OPTCR: u32 = 0x4002_3C14;

const RCC_AHB1ENR: u32 = 0x4002_3830;

const BSY: u32 = 1 << 16;
const WRPERR: u32 = 1 << 4;
const PGPERR: u32 = 1 << 6;
const PGSERR: u32 = 1 << 7;
const X32: u32 = 2 << 8;
const PG: u32 = 1;
const SER: u32 = 2;
const STRT: u32 = 1 << 16;

/// A chip and the time of its next access.
struct FlashRig {
    chip: Chip,
    now: Time,
}

impl FlashRig {
    fn new(part: Part) -> Self {
        let crystal = Clock { hz: 8_000_000, ppm: 0 };
        Self { chip: Chip::new(part, crystal, [0; 12]), now: Time::ZERO }
    }

    fn unlocked(part: Part) -> Self {
        let mut rig = Self::new(part);
        rig.unlock();
        rig
    }

    fn unlock(&mut self) {
        self.write(KEYR, 0x4567_0123).expect("the first key");
        self.write(KEYR, 0xCDEF_89AB).expect("the second key");
    }

    fn store(&mut self, address: u32, width: Width, value: u32) -> Result<(), BusFault> {
        self.now += Time::from_ns(100);
        self.chip.write(Access { address, width, now: self.now, pc: 0 }, value)
    }

    fn write(&mut self, address: u32, value: u32) -> Result<(), BusFault> {
        self.store(address, Width::Word, value)
    }

    fn set(&mut self, address: u32, value: u32) {
        self.write(address, value).expect("no bus error");
    }

    fn read(&mut self, address: u32) -> u32 {
        self.now += Time::from_ns(100);
        let access = Access { address, width: Width::Word, now: self.now, pc: 0 };
        self.chip.read(access).expect("no bus error")
    }

    fn flash(&self, offset: usize) -> u32 {
        let bytes = &self.chip.flash().bytes()[offset..offset + 4];
        u32::from_le_bytes(bytes.try_into().expect("four bytes"))
    }

    /// Waits for the end of an operation and returns how long it took.
    fn wait(&mut self) -> Time {
        let start = self.now;
        if let Some(end) = self.chip.flash().operation_end() {
            assert_ne!(self.read(SR) & BSY, 0);
            self.now = end;
        }
        assert_eq!(self.read(SR) & BSY, 0);
        self.now - start
    }

    fn program(&mut self, offset: u32, value: u32) {
        self.set(CR, X32 | PG);
        self.set(0x0800_0000 + offset, value);
    }

    fn erase(&mut self, number: u32) {
        self.set(CR, X32 | SER | number << 3);
        self.set(CR, X32 | SER | number << 3 | STRT);
    }
}

#[test]
fn programming_clears_bits_and_never_sets_them() {
    let mut rig = FlashRig::unlocked(Part::Stm32f405);
    rig.program(0x4000, 0x00FF_1234);
    assert!(rig.wait() >= Time::from_us(16));
    rig.program(0x4000, 0xFF0F_FFF0);
    rig.wait();
    assert_eq!(rig.flash(0x4000), 0x000F_1230);
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
    for (part, number, range) in Part::ALL.into_iter().flat_map(first_four).chain(others) {
        let mut rig = FlashRig::unlocked(part);
        rig.chip.flash_mut().load(0, &vec![0; part.flash_size() as usize]);
        rig.erase(number);
        rig.wait();
        let mut expected = vec![0; part.flash_size() as usize];
        expected[range].fill(0xFF);
        assert!(rig.chip.flash().bytes() == expected, "{part:?}, sector {number}");
    }
}

#[test]
fn a_sector_that_the_part_lacks_is_a_sequence_error() {
    for (part, number) in [
        (Part::Stm32f405, 12),
        (Part::Stm32f413, 16),
        (Part::Stm32f427, 12),
        (Part::Stm32f446, 8),
        (Part::Stm32f469, 15),
    ] {
        let mut rig = FlashRig::unlocked(part);
        rig.erase(number);
        assert_eq!(rig.read(SR), PGSERR, "{part:?}");
        assert_eq!(rig.chip.flash().operations(), 0);
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
        let mut rig = FlashRig::unlocked(part);
        rig.chip.flash_mut().set_timing(timing);
        rig.set(CR, size << 8 | SER | sector << 3 | STRT);
        assert_eq!(rig.wait().as_ms(), ms, "{part:?}, {timing:?}, sector {sector}");
    }
}

#[test]
fn the_last_protection_bit_of_an_f413_is_for_two_sectors() {
    for (protected, bits) in [(13, 0x5FFF), (14, 0x3FFF), (15, 0x3FFF)] {
        let mut rig = FlashRig::unlocked(Part::Stm32f413);
        rig.chip.flash_mut().protect_sectors(1 << protected);
        assert_eq!(rig.read(OPTCR) >> 16, bits);
        for number in 12..16 {
            rig.erase(number);
            rig.wait();
            let is_refused = rig.read(SR) & WRPERR != 0;
            let is_protected = number == protected || protected >= 14 && number >= 14;
            assert_eq!(is_refused, is_protected, "sector {number}, {protected} protected");
            rig.set(SR, WRPERR);
        }
    }
}

#[test]
fn a_store_without_pg_or_in_the_wrong_width_is_reported_and_does_nothing() {
    let mut rig = FlashRig::unlocked(Part::Stm32f405);
    rig.set(0x0800_4000, 0);
    assert_eq!((rig.read(SR), rig.flash(0x4000)), (PGSERR, u32::MAX));
    rig.set(SR, PGSERR);
    rig.set(CR, X32 | PG);
    rig.store(0x0800_4000, Width::Byte, 0).expect("no bus error");
    assert_eq!((rig.read(SR), rig.flash(0x4000)), (PGPERR, u32::MAX));
    rig.set(SR, PGPERR);
    assert_eq!(rig.read(SR), 0);
}

#[test]
fn a_protected_sector_can_be_neither_programmed_nor_erased() {
    let mut rig = FlashRig::unlocked(Part::Stm32f405);
    rig.chip.flash_mut().protect_sectors(1 << 2);
    assert_eq!(rig.read(OPTCR) >> 16, 0x0FFB);
    rig.program(0x8000, 0);
    assert_eq!(rig.read(SR), WRPERR);
    rig.set(SR, WRPERR);
    rig.erase(2);
    assert_eq!(rig.read(SR), WRPERR);
    rig.set(SR, WRPERR);
    rig.program(0x4000, 0);
    rig.wait();
    assert_eq!((rig.flash(0x8000), rig.flash(0x4000)), (u32::MAX, 0));
}

#[test]
fn a_wrong_key_is_a_bus_error_and_locks_until_reset() {
    let mut rig = FlashRig::new(Part::Stm32f405);
    assert_eq!(rig.write(KEYR, 0x4567_0124), Err(BusFault));
    assert_eq!(rig.write(KEYR, 0x4567_0123), Err(BusFault));
    assert_eq!(rig.write(KEYR, 0xCDEF_89AB), Err(BusFault));
    assert_eq!(rig.read(CR), 1 << 31);
    rig.chip.reset(ResetCause::Software, rig.now);
    rig.set(KEYR, 0x4567_0123);
    rig.set(KEYR, 0xCDEF_89AB);
    assert_eq!(rig.read(CR), 0);
}

#[test]
fn a_locked_control_register_keeps_its_value_and_the_write_is_found() {
    let mut rig = FlashRig::new(Part::Stm32f405);
    rig.set(CR, PG);
    assert_eq!(rig.read(CR), 1 << 31);
    assert_eq!(rig.chip.findings().len(), 1);
}

#[test]
fn a_write_that_locks_starts_nothing_and_is_found() {
    let mut rig = FlashRig::unlocked(Part::Stm32f405);
    rig.set(CR, 1 << 31 | X32 | SER | 1 << 3 | STRT);
    assert_eq!(rig.read(CR), 1 << 31);
    assert_eq!((rig.chip.flash().operations(), rig.chip.findings().len()), (0, 1));
}

#[test]
fn an_erase_behind_the_data_cache_is_found_unless_the_cache_is_reset() {
    const DCEN: u32 = 1 << 10;
    const DCRST: u32 = 1 << 12;
    for reset in [false, true] {
        let mut rig = FlashRig::unlocked(Part::Stm32f405);
        rig.set(ACR, DCEN);
        rig.erase(1);
        rig.wait();
        rig.set(CR, 1 << 31);
        if reset {
            rig.set(ACR, 0);
            rig.set(ACR, DCRST);
            rig.set(ACR, 0);
            rig.set(ACR, DCEN);
        }
        rig.set(RCC_AHB1ENR, 1);
        assert_eq!(rig.chip.findings().is_empty(), reset);
    }
}

#[test]
fn only_the_bank_that_works_stalls_its_readers() {
    let mut rig = FlashRig::unlocked(Part::Stm32f427);
    rig.erase(16);
    let now = rig.now;
    assert_eq!(rig.chip.stalled_until(0x0800_C000, now), None);
    assert!(rig.chip.stalled_until(0x0810_0000, now).is_some());
    assert_eq!(rig.chip.stalled_until(0x2000_0000, now), None);
}

#[test]
fn stuck_bits_survive_programming_and_erasing() {
    let mut rig = FlashRig::unlocked(Part::Stm32f405);
    let stuck = StuckBits { offset: 0x4001, mask: 0x11, value: 0x01 };
    rig.chip.flash_mut().add_stuck_bits(stuck);
    rig.erase(1);
    rig.wait();
    assert_eq!(rig.flash(0x4000), 0xFFFF_EFFF);
    rig.program(0x4000, 0);
    rig.wait();
    assert_eq!(rig.flash(0x4000), 0x0000_0100);
}

#[test]
fn a_failing_erase_leaves_other_than_blank_without_a_flag() {
    let mut rig = FlashRig::unlocked(Part::Stm32f405);
    rig.chip.flash_mut().load(0x4000, &[0; 0x4000]);
    rig.chip.flash_mut().fail_erases(1, 0);
    rig.erase(1);
    rig.wait();
    let sector = |rig: &FlashRig| rig.chip.flash().bytes()[0x4000..0x8000].to_vec();
    assert!(sector(&rig).iter().any(|&byte| byte != 0xFF));
    assert_eq!(rig.read(SR), 0);
    rig.erase(1);
    rig.wait();
    assert!(sector(&rig).iter().all(|&byte| byte == 0xFF));
}

#[test]
fn a_failing_program_operation_leaves_a_bit_without_a_flag() {
    let mut rig = FlashRig::unlocked(Part::Stm32f405);
    rig.chip.flash_mut().fail_programs(1);
    for (at, left) in [(0x4000_u32, 0x1234_5679), (0x4004, 0x1234_5678)] {
        rig.program(at, 0x1234_5678);
        rig.wait();
        assert_eq!(rig.flash(at as usize), left);
        assert_eq!(rig.read(SR), 0);
    }
}

#[test]
fn a_refused_program_operation_sets_a_flag_and_no_bit() {
    let mut rig = FlashRig::unlocked(Part::Stm32f405);
    rig.chip.flash_mut().refuse_programs(1);
    rig.program(0x4000, 0x1234_5678);
    assert_eq!((rig.read(SR), rig.flash(0x4000)), (PGSERR, u32::MAX));
    rig.program(0x4000, 0x1234_5678);
    rig.wait();
    assert_eq!(rig.flash(0x4000), 0x1234_5678);
}

#[test]
fn a_power_cut_leaves_a_word_between_its_old_and_its_new_value() {
    let mut torn = 0;
    for seed in 0..200 {
        let mut rig = FlashRig::unlocked(Part::Stm32f405);
        rig.chip.flash_mut().cut_power(PowerCut { operation: 1, seed });
        rig.program(0x4000, 0x1234_5678);
        rig.wait();
        rig.program(0x4004, 0x0F0F_0000);
        let cut = rig.chip.next_event();
        assert!(cut > rig.now && cut < rig.now + Time::from_us(17), "seed {seed}");
        rig.chip.advance(cut);
        assert_eq!(rig.chip.take_request(), Some(Request::PowerCut), "seed {seed}");
        rig.chip.reset(ResetCause::PowerOn, cut);
        assert_eq!(rig.flash(0x4000), 0x1234_5678, "seed {seed}");
        let word = rig.flash(0x4004);
        assert_eq!(word & 0x0F0F_0000, 0x0F0F_0000, "seed {seed}");
        torn += u32::from(word != 0x0F0F_0000 && word != u32::MAX);
        assert_eq!(rig.chip.next_event(), Time::MAX, "seed {seed}");
    }
    assert!(torn > 150, "{torn} of 200 words were torn");
}

#[test]
fn a_power_cut_in_an_erase_leaves_any_state_but_spares_other_sectors() {
    for seed in 0..20 {
        let mut rig = FlashRig::unlocked(Part::Stm32f405);
        let flash = rig.chip.flash_mut();
        flash.load(0, &[0x5A; 0xC000]);
        flash.cut_power(PowerCut { operation: 0, seed });
        rig.erase(1);
        let cut = rig.chip.next_event();
        rig.chip.reset(ResetCause::PowerOn, cut);
        let bytes = rig.chip.flash().bytes();
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
    let crystal = Clock { hz: 8_000_000, ppm: 0 };
    let chip = Chip::with_variant(Part::Stm32f405, crystal, [0; 12], variant);
    let mut rig = FlashRig { chip, now: Time::ZERO };
    rig.unlock();
    rig.chip.flash_mut().cut_power(PowerCut { operation: 0, seed: 100 });
    rig.program(0x4000, 0x1234_5678);
    let mut seen = BTreeSet::new();
    for _ in 0..50 {
        rig.chip.reset(ResetCause::PowerOn, rig.now);
        let word = rig.flash(0x4000);
        assert_eq!(word & 0x1234_5678, 0x1234_5678, "{word:#x}");
        seen.insert(word);
    }
    assert!(
        seen.len() > 10 && seen.contains(&0x1234_5678) && seen.contains(&u32::MAX),
        "{seen:x?}"
    );
    rig.unlock();
    rig.program(0x4000, 0x1234_5678);
    rig.wait();
    for _ in 0..20 {
        rig.chip.reset(ResetCause::PowerOn, rig.now);
        assert_eq!(rig.flash(0x4000), 0x1234_5678);
    }
}

#[test]
fn all_registers_but_the_keys_take_bytes_and_half_words() {
    let mut rig = FlashRig::unlocked(Part::Stm32f405);
    rig.set(ACR, 0x0700);
    rig.store(ACR, Width::Byte, 5).expect("no bus error");
    assert_eq!(rig.read(ACR), 0x0705);
    rig.store(CR + 1, Width::Byte, 2).expect("no bus error");
    rig.store(CR, Width::Byte, 1).expect("no bus error");
    assert_eq!(rig.read(CR), X32 | PG);
    // A byte store while PSIZE selects words.
    rig.store(0x0800_4000, Width::Byte, 0).expect("no bus error");
    rig.set(CR, X32);
    rig.set(0x0800_4000, 0);
    assert_eq!(rig.read(SR), PGPERR | PGSERR);
    rig.store(SR, Width::Half, PGPERR).expect("no bus error");
    assert_eq!(rig.read(SR), PGSERR);
    assert_eq!(rig.chip.findings(), []);
    rig.store(KEYR, Width::Half, 0x0123).expect("no bus error");
    assert_eq!(rig.chip.findings().len(), 1);
}

#[test]
fn option_bytes_hold_through_a_power_cycle() {
    const BOR_OFF: u32 = 0x0FFF_AAED;
    const BOR_LEVEL_3: u32 = 0x0FFF_AAE0;
    let mut rig = FlashRig::new(Part::Stm32f405);
    assert_eq!((rig.read(OPTCR), rig.read(0x1FFF_C000) & 0xFFFF), (BOR_OFF, 0xAAEF));
    rig.set(OPTCR, BOR_LEVEL_3 | 2);
    assert_eq!((rig.read(OPTCR), rig.chip.findings().len()), (BOR_OFF, 1), "locked");
    rig.set(OPTKEYR, 0x0819_2A3B);
    rig.set(OPTKEYR, 0x4C5D_6E7F);
    // Write protection of sector 1, too.
    rig.set(OPTCR, BOR_LEVEL_3 & !(1 << 17));
    rig.set(OPTCR, BOR_LEVEL_3 & !(1 << 17) | 2);
    assert!(rig.wait() > Time::from_ms(100));
    rig.chip.reset(ResetCause::PowerOn, rig.now);
    assert_eq!(rig.read(OPTCR), BOR_LEVEL_3 & !(1 << 17) | 1);
    assert_eq!((rig.read(0x1FFF_C000) & 0xFFFF, rig.read(0x1FFF_C008)), (0xAAE3, 0xFFFF_FFFD));
    rig.unlock();
    rig.program(0x4000, 0);
    assert_eq!(rig.read(SR), WRPERR);
    assert_eq!(rig.chip.findings().len(), 1);
}

#[test]
fn words_below_2_7_v_and_double_words_without_vpp_are_found() {
    let finds = |mv: u32, psize: u32| {
        let mut rig = FlashRig::unlocked(Part::Stm32f405);
        rig.chip.set_supply(mv);
        rig.set(CR, psize << 8 | PG);
        let width = [Width::Byte, Width::Half, Width::Word, Width::Word][psize as usize];
        rig.store(0x0800_4000, width, 0).expect("no bus error");
        rig.chip.findings().len()
    };
    let cases = [(3_300, 2, 0), (2_700, 2, 0), (2_699, 2, 1), (2_699, 1, 0), (2_000, 1, 1)];
    for (mv, psize, findings) in cases.into_iter().chain([(1_800, 0, 0), (3_300, 3, 1)]) {
        assert_eq!(finds(mv, psize), findings, "{mv} mV, PSIZE {psize}");
    }
}

#[test]
fn the_end_of_an_operation_interrupts_only_if_asked_to() {
    const EOPIE: u32 = 1 << 24;
    for enable in [0, EOPIE] {
        let mut rig = FlashRig::unlocked(Part::Stm32f405);
        rig.set(CR, X32 | PG | enable);
        rig.set(0x0800_4000, 0);
        rig.wait();
        assert_eq!(rig.read(SR), u32::from(enable != 0));
        assert_eq!(rig.chip.irqs() >> 4 & 1, u128::from(enable != 0));
    }
}
