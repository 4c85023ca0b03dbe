//! Clocks, reset and flash of an STM32G431, as seen by a program (RM0440 chapters 3, 6 and 7).

use emulator::{
    Time,
    chip::{BusFault, Part, Pin, PowerCut, Problem, Request, ResetCause, Timing, Width},
    network::Short,
};

use crate::rig::Rig;

const CR: u32 = 0x4002_1000;
const CFGR: u32 = 0x4002_1008;
const PLLCFGR: u32 = 0x4002_100C;
const AHB2ENR: u32 = 0x4002_104C;
const APB1ENR1: u32 = 0x4002_1058;
const BDCR: u32 = 0x4002_1090;
const PWR_CR1: u32 = 0x4000_7000;
const PWR_CR5: u32 = 0x4000_7080;
const ACR: u32 = 0x4002_2000;
const KEYR: u32 = 0x4002_2008;
const FLASH_SR: u32 = 0x4002_2010;
const FLASH_CR: u32 = 0x4002_2014;
const FLASH_ECCR: u32 = 0x4002_2018;
const FLASH_OPTR: u32 = 0x4002_2020;
const FLASH: u32 = 0x0800_0000;

const PG: u32 = 1 << 0;
const PER: u32 = 1 << 1;
const STRT: u32 = 1 << 16;
const PROGERR: u32 = 1 << 3;
const PGAERR: u32 = 1 << 5;
const SIZERR: u32 = 1 << 6;
const PGSERR: u32 = 1 << 7;

/// PLL with 8 MHz / 2 * `n`, a fourth for Q and a half for R, which is SYSCLK.
fn on_pll(n: u32, wait_states: u32, boost: bool) -> Rig {
    let mut rig = Rig::new(Part::Stm32g431);
    rig.write(APB1ENR1, 1 << 28);
    if boost {
        rig.write(PWR_CR5, 0);
    }
    let pllcfgr = 3 | 1 << 4 | n << 8 | 1 << 20 | 1 << 21 | 1 << 24;
    rig.write_all(&[(ACR, wait_states), (CR, 1 << 16 | 1 << 8), (PLLCFGR, pllcfgr)]);
    rig.at_us(10_000).write(CR, 1 << 24 | 1 << 16 | 1 << 8);
    rig.at_us(11_000).write(CFGR, 4 << 8 | 3);
    rig
}

/// 3.3.3, wait states, and 6.1.5, ranges.
#[test]
fn speed_needs_wait_states_and_above_150_mhz_the_boost() {
    let problems = |n, wait_states, boost| on_pll(n, wait_states, boost).problems();
    let few = Problem::Misuse("too few flash wait states for this HCLK and supply");
    let fast = Problem::Misuse("HCLK above the limit of the voltage scale (PWR_CR.VOS)");
    assert_eq!(problems(80, 5, false), [fast]);
    assert_eq!(problems(80, 3, true), [few]);
    assert_eq!(problems(34, 2, false), []);
    assert_eq!(problems(34, 1, false), [few]);
    assert_eq!(problems(34, 1, true), [], "68 MHz");
}

#[test]
fn misuse_of_the_clocks_is_found() {
    for (register, value) in [
        (CFGR, 3),
        (CFGR, 2),
        (CR, 1 << 8 | 1 << 19),
        (PWR_CR1 + 0x84, 0),
        (BDCR, 1),
        (0x4002_10A0, 0),
    ] {
        let mut rig = Rig::new(Part::Stm32g431);
        rig.write_all(&[(APB1ENR1, 1 << 28), (PWR_CR1, 1 << 8 | 1 << 9), (register, value)]);
        assert_eq!(rig.findings().len(), 1, "{register:08x}");
    }
    let mut rig = Rig::new(Part::Stm32g431);
    rig.write_all(&[(PLLCFGR, 2 | 127 << 8), (CR, 1 << 24 | 1 << 8)]);
    assert_eq!(rig.problems(), [Problem::Misuse("PLL VCO outside 96..344 MHz")]);
    rig.read(0x4800_0000);
    assert_eq!(rig.problems()[1], Problem::ClockOff, "GPIOA");
}

fn unlocked() -> Rig {
    let mut rig = Rig::new(Part::Stm32g431);
    rig.write_all(&[(KEYR, 0x4567_0123), (KEYR, 0xCDEF_89AB)]);
    rig
}

impl Rig {
    fn program_both(&mut self, offset: u32, value: u64) {
        self.write(FLASH_CR, PG);
        self.write(FLASH + offset, value as u32);
        self.write(FLASH + offset + 4, (value >> 32) as u32);
    }

    fn finish(&mut self) {
        self.now = self.flash().operation_end().expect("it is busy");
        self.write(FLASH_CR, 0);
    }

    fn double_word(&self, offset: usize) -> u64 {
        let bytes = &self.flash().bytes()[offset..offset + 8];
        u64::from_le_bytes(bytes.try_into().expect("eight bytes"))
    }
}

/// 3.3.7.
#[test]
fn a_double_word_is_programmed_once_after_an_erase_or_cleared() {
    let mut rig = unlocked();
    rig.program_both(0x1000, 0x1122_3344_5566_7788);
    assert_eq!(rig.flash().operations(), 1);
    assert_eq!(rig.read(FLASH_SR), 1 << 16);
    rig.finish();
    assert_eq!(rig.double_word(0x1000), 0x1122_3344_5566_7788);
    rig.program_both(0x1000, 0x1122_3344_5566_7780);
    assert_eq!((rig.read(FLASH_SR), rig.problems().len()), (PROGERR, 1));
    rig.program_both(0x1008, 0);
    assert_eq!(rig.read(FLASH_SR), PROGERR | PGSERR, "the error was not cleared");
    rig.write(FLASH_SR, PROGERR | PGSERR);
    rig.program_both(0x1000, 0);
    rig.finish();
    assert_eq!(rig.double_word(0x1000), 0);
    rig.write_all(&[(FLASH_CR, PER | 2 << 3), (FLASH_CR, PER | 2 << 3 | STRT)]);
    rig.finish();
    assert_eq!(rig.double_word(0x1000), u64::MAX);
}

/// 3.3.8, errors.
#[test]
fn what_is_not_a_double_word_is_an_error() {
    for (stores, error) in [
        (&[(0x1004, Width::Word)][..], PGAERR),
        (&[(0x1000, Width::Word), (0x1000, Width::Word)], PGAERR),
        (&[(0x1000, Width::Half)], SIZERR),
        (&[(0x1000, Width::Byte)], SIZERR),
    ] {
        let mut rig = unlocked();
        rig.write(FLASH_CR, PG);
        for (offset, width) in stores {
            rig.store(FLASH + offset, *width, 0).expect("no bus error");
        }
        assert_eq!(rig.read(FLASH_SR), error);
        assert_eq!(rig.double_word(0x1000), u64::MAX);
    }
    let mut rig = unlocked();
    rig.write(FLASH, 0);
    assert_eq!(rig.read(FLASH_SR), PGSERR, "without PG");
    assert_eq!(rig.store(KEYR, Width::Word, 1), Err(BusFault));
}

#[test]
fn an_erase_sets_its_page_in_the_time_of_the_data_sheet() {
    for (page, timing, us) in [(0, Timing::Typical, 22_000), (63, Timing::Worst, 24_500)] {
        let mut rig = unlocked();
        rig.flash_mut().load(0, &[0; 128 * 1024]);
        rig.flash_mut().set_timing(timing);
        rig.write_all(&[(FLASH_CR, PER | page << 3), (FLASH_CR, PER | page << 3 | STRT)]);
        rig.finish();
        assert_eq!(rig.now, Time::from_us(us));
        let erased = page as usize * 2048..(page as usize + 1) * 2048;
        for (offset, byte) in rig.flash().bytes().iter().enumerate() {
            assert_eq!(*byte == 0xFF, erased.contains(&offset), "{offset:x}");
        }
    }
    let mut rig = unlocked();
    rig.write_all(&[(FLASH_CR, PER | 64 << 3), (FLASH_CR, PER | 64 << 3 | STRT)]);
    assert_eq!(rig.read(FLASH_SR), PGSERR, "there is no page 64");
}

/// 3.3.4: a double error.
#[test]
fn an_interrupted_double_word_reads_as_before_as_new_or_as_an_error() {
    let value = 0x1122_3344_5566_7788;
    let mut kinds = [0; 3];
    for seed in 0..60 {
        let mut rig = unlocked();
        rig.flash_mut().cut_power(PowerCut { operation: 0, seed });
        rig.program_both(0x1000, value);
        let at = rig.next_event();
        assert_eq!(rig.advance(at), Some(Request::PowerCut));
        rig.at(at).reset_now(ResetCause::PowerOn);
        let kind = match rig.double_word(0x1000) {
            u64::MAX => 0,
            read if read == value => 1,
            _ => 2,
        };
        kinds[kind] += 1;
        rig.flash_mut().note_read(0x0FF8, 8);
        rig.flash_mut().note_read(0x1008, 8);
        assert!(!rig.nmi());
        rig.flash_mut().note_read(0x1004, 1);
        assert_eq!(rig.nmi(), kind == 2);
        assert_eq!(rig.read(FLASH_ECCR), if kind == 2 { 1 << 31 | 0x1000 } else { 0 });
        rig.write(FLASH_ECCR, 1 << 31);
        assert!(!rig.nmi());
        assert_eq!(rig.double_word(0x1008), u64::MAX);
    }
    assert!(kinds.iter().all(|count| *count > 5), "{kinds:?}");
}

#[test]
fn an_interrupted_erase_leaves_double_errors_until_the_next_erase() {
    let mut rig = unlocked();
    rig.flash_mut().load(0, &[0; 128 * 1024]);
    rig.flash_mut().cut_power(PowerCut { operation: 0, seed: 1 });
    let erase = [(FLASH_CR, PER | 3 << 3), (FLASH_CR, PER | 3 << 3 | STRT)];
    rig.write_all(&erase);
    let at = rig.next_event();
    assert_eq!(rig.advance(at), Some(Request::PowerCut));
    rig.at(at).reset_now(ResetCause::PowerOn);
    let words: Vec<u32> = rig.flash().double_errors().collect();
    assert!((50..200).contains(&words.len()), "{}", words.len());
    assert!(words.iter().all(|word| (3 * 2048..4 * 2048).contains(word)));
    rig.write_all(&[(KEYR, 0x4567_0123), (KEYR, 0xCDEF_89AB)]);
    rig.write_all(&erase);
    rig.finish();
    assert_eq!(rig.flash().double_errors().count(), 0);
}

/// 2.6: nSWBOOT0 and nBOOT0 in FLASH_OPTR, and PB8.
#[test]
fn pb8_high_at_a_reset_starts_the_boot_loader_unless_nswboot0_is_0() {
    const FACTORY: u32 = 0xFFEF_F8AA;
    let by_option = FACTORY & !(1 << 26);
    for (optr, level, stays) in [
        (FACTORY, None, false),
        (FACTORY, Some(false), false),
        (FACTORY, Some(true), true),
        (by_option, Some(true), false),
        (by_option & !(1 << 27), Some(false), true),
    ] {
        let mut rig = Rig::new(Part::Stm32g431);
        rig.flash_mut().set_option_register(optr);
        rig.gpio_mut().set_input(Pin('B', 8), level);
        assert_eq!(rig.read(FLASH_OPTR), optr);
        rig.reset_now(ResetCause::Pin);
        assert_eq!((rig.stays_in_loader(), rig.findings().len()), (stays, usize::from(stays)));
        rig.gpio_mut().set_input(Pin('B', 8), Some(false));
        rig.flash_mut().set_option_register(FACTORY);
        rig.reset_now(ResetCause::Pin);
        assert!(!rig.stays_in_loader());
    }
}

/// A transceiver drives its receive pin high while the bus is recessive.
#[test]
fn a_program_that_receives_on_pb8_is_started_again_into_the_boot_loader() {
    const GPIOA: u32 = 0x4800_0000;
    const GPIOB: u32 = 0x4800_0400;
    for (port, afrh, moder, is_boot0) in
        [(GPIOB, 9, 0xFFFE_FEBF, true), (GPIOA, 9 << 12 | 9 << 16, 0xAA3F_FFFF, false)]
    {
        let mut rig = Rig::new(Part::Stm32g431);
        rig.write_all(&[(AHB2ENR, 3), (port + 0x24, afrh), (port, moder)]);
        let request = is_boot0.then_some(Request::Reset(ResetCause::PowerOn));
        assert_eq!(rig.advance(Time::from_us(1)), request);
        for cause in [ResetCause::PowerOn, ResetCause::Software] {
            rig.reset_now(cause);
            assert_eq!(rig.stays_in_loader(), is_boot0);
        }
        assert_eq!(rig.advance(Time::from_us(1)), None);
        let now = rig.now;
        rig.buses[0].0.set_short(Some(Short::Dominant), now);
        rig.run_us(1);
        rig.reset_now(ResetCause::Software);
        assert!(!rig.stays_in_loader(), "the bus is dominant");
    }
}
