//! The registers of the timers as seen by a program, without a CPU.

use emulator::{
    Time,
    can::Clock,
    chip::{ChipVariant, Part, Problem, Width},
};

use crate::rig::{FLASH_ACR, RCC_APB1ENR, RCC_APB2ENR, RCC_CFGR, RCC_CR, RCC_PLLCFGR, Rig};

const TIM2: u32 = 0x4000_0000;
const TIM5: u32 = 0x4000_0C00;
const CR1: u32 = 0x00;
const DIER: u32 = 0x0C;
const SR: u32 = 0x10;
const EGR: u32 = 0x14;
const CNT: u32 = 0x24;
const PSC: u32 = 0x28;
const ARR: u32 = 0x2C;
const CCR1: u32 = 0x34;
const CCR4: u32 = 0x40;

const TIM2_IRQ: u32 = 28;
const TIM5_IRQ: u32 = 50;

/// A chip at 16 MHz with `timer` counting microseconds from time zero on.
fn counting(timer: u32) -> Rig {
    let mut rig = Rig::new(Part::Stm32f405);
    rig.write(RCC_APB1ENR, 1 << 3 | 1 << 0);
    set(&mut rig, timer, &[(PSC, 15), (EGR, 1), (SR, 0), (CR1, 1)]);
    rig
}

/// Writes registers of a timer.
fn set(rig: &mut Rig, timer: u32, registers: &[(u32, u32)]) {
    registers.iter().for_each(|(register, value)| rig.write(timer + register, *value));
}

#[test]
fn a_timer_counts_its_clock_divided_by_the_prescaler() {
    for timer in [TIM2, TIM5] {
        let mut rig = counting(timer);
        for us in [0, 1, 2, 999, 123_456_789] {
            let now = Time::from_us(us);
            assert_eq!(u64::from(rig.at(now).read(timer + CNT)), us);
            let almost = now + Time::from_ns(999);
            assert_eq!(u64::from(rig.at(almost).read(timer + CNT)), us);
        }
        assert_eq!(rig.problems(), []);
    }
}

#[test]
fn a_timer_counts_twice_as_fast_as_a_slow_apb1_with_the_crystals_error() {
    let mut rig = Rig::new(Part::Stm32f405);
    let ready = Time::from_ms(10);
    let pll = 1 << 22 | 160 << 6 | 4;
    rig.write_all(&[(FLASH_ACR, 5), (RCC_PLLCFGR, pll), (RCC_CR, 0x0101_0083)]);
    rig.at(ready).write_all(&[(RCC_CFGR, 4 << 13 | 5 << 10 | 2), (RCC_APB1ENR, 1)]);
    assert_eq!(rig.clocks().timclk1, Clock { hz: 80_000_000, ppm: 20 });
    set(&mut rig, TIM2, &[(PSC, 79), (EGR, 1), (CR1, 1)]);
    assert_eq!(rig.at(ready + Time::from_s(1)).read(TIM2 + CNT), 1_000_020);
    assert_eq!(rig.problems(), []);
}

#[test]
fn a_timer_wraps_at_32_bits_or_at_its_auto_reload_value() {
    let mut rig = counting(TIM2);
    rig.write(TIM2 + CNT, 0xFFFF_FFFE);
    let counts = [0, 1, 2, 3].map(|us| rig.at_us(us).read(TIM2 + CNT));
    assert_eq!(counts, [0xFFFF_FFFE, 0xFFFF_FFFF, 0, 1]);
    assert_eq!(rig.at_us(3).read(TIM2 + SR) & 1, 1);

    let mut rig = counting(TIM5);
    rig.write(TIM5 + ARR, 9);
    assert_eq!(rig.at_us(9).read(TIM5 + SR) & 1, 0);
    assert_eq!(rig.at_us(10).read(TIM5 + SR) & 1, 1);
    assert_eq!(rig.at_us(25).read(TIM5 + CNT), 5);
}

#[test]
fn a_compare_interrupts_at_its_count_until_the_flag_is_cleared() {
    for (timer, irq) in [(TIM2, TIM2_IRQ), (TIM5, TIM5_IRQ)] {
        let mut rig = counting(timer);
        rig.write(timer + CCR1, 1_000);
        assert_eq!(rig.next_event(), Time::MAX, "it does not interrupt");
        rig.write(timer + DIER, 1 << 1);
        let at = Time::from_ms(1);
        assert_eq!(rig.next_event(), at);
        rig.advance(Time::from_us(999));
        assert_eq!(rig.irqs(), 0);
        rig.advance(at);
        assert_eq!(rig.irqs(), 1 << irq);
        assert_eq!(rig.at(at).read(timer + SR), 1 << 1);
        rig.at(at).write(timer + SR, !(1 << 1));
        assert_eq!(rig.irqs(), 0);
        assert_eq!(rig.problems(), []);
    }
}

#[test]
fn each_channel_has_its_own_compare_and_the_earliest_comes_first() {
    let mut rig = counting(TIM2);
    for channel in 0..4 {
        rig.write(TIM2 + CCR1 + 4 * channel, 400 - 100 * channel);
    }
    set(&mut rig, TIM2, &[(SR, 0), (DIER, 0b11110)]);
    assert_eq!(rig.next_event(), Time::from_us(100));
    for (us, flags) in [(100, 0b10000), (200, 0b11000), (300, 0b11100), (400, 0b11110)] {
        assert_eq!(rig.at_us(us).read(TIM2 + SR), flags);
    }
}

#[test]
fn a_compare_with_the_present_count_or_an_earlier_one_is_late_by_a_turn() {
    let mut rig = counting(TIM2);
    rig.write(TIM2 + DIER, 1 << 1);
    for value in [50, 49] {
        rig.at_us(50).write(TIM2 + CCR1, value);
        assert!(rig.next_event() > Time::from_s(4_294), "at {value}");
    }
    rig.at_us(50).write(TIM2 + CCR1, 51);
    assert_eq!(rig.next_event(), Time::from_us(51));
}

#[test]
fn a_stopped_timer_keeps_its_count_and_an_update_clears_it() {
    let mut rig = counting(TIM2);
    rig.at_us(70).write(TIM2 + CR1, 0);
    assert_eq!(rig.at_us(90).read(TIM2 + CNT), 70);
    rig.at_us(100).write(TIM2 + CR1, 1);
    assert_eq!(rig.at_us(105).read(TIM2 + CNT), 75);
    rig.at_us(110).write(TIM2 + EGR, 1);
    assert_eq!(rig.at_us(111).read(TIM2 + CNT), 1);
    assert_eq!(rig.at_us(111).read(TIM2 + SR) & 1, 1);
    rig.at_us(120).reset_by_rcc(1);
    let registers = [CR1, CNT, PSC, ARR, CCR4];
    let values = registers.map(|register| rig.at_us(130).read(TIM2 + register));
    assert_eq!(values, [0, 0, 0, u32::MAX, 0]);
}

#[test]
fn a_timer_of_16_bits_ignores_the_upper_half_of_the_bus() {
    const TIM12: u32 = 0x4000_1800;
    let mut rig = Rig::new(Part::Stm32f405);
    rig.write(RCC_APB1ENR, 1 << 6);
    // The bridge repeats a half-word in the upper half.
    for (register, value) in [(PSC, 15), (ARR, 0xFFFF), (EGR, 1), (SR, 0xFFFE), (CCR1, 0x8000)] {
        rig.store(TIM12 + register, Width::Half, value).expect("no bus error");
    }
    set(&mut rig, TIM12, &[(DIER, 1 << 1 | 1 << 0), (CR1, 1)]);
    for (us, irqs, flag) in [(0x8000, 1 << 43, 1 << 1), (0x1_0000, 1 << 43, 1 << 0)] {
        let at = Time::from_us(us);
        assert_eq!(rig.next_event(), at);
        rig.advance(at);
        assert_eq!(rig.irqs(), irqs);
        assert_eq!(rig.at(at).read(TIM12 + CNT), us as u32 & 0xFFFF);
        rig.at(at).write(TIM12 + SR, !flag);
        assert_eq!(rig.irqs(), 0);
    }
    assert_eq!(rig.problems(), []);
    assert_eq!(rig.at_us(70_000).read(TIM12 + CCR4), 0);
    assert_eq!(rig.problems(), [Problem::Unmodelled], "it has two channels");
}

#[test]
fn every_timer_interrupts_on_its_own_line() {
    for (timer, irq) in [
        (0x4001_0000, 25),
        (0x4000_0000, 28),
        (0x4000_0400, 29),
        (0x4000_0800, 30),
        (0x4000_0C00, 50),
        (0x4000_1000, 54),
        (0x4000_1400, 55),
        (0x4001_0400, 44),
        (0x4001_4000, 24),
        (0x4001_4400, 25),
        (0x4001_4800, 26),
        (0x4000_1800, 43),
        (0x4000_1C00, 44),
        (0x4000_2000, 45),
    ] {
        let mut rig = Rig::new(Part::Stm32f405);
        rig.write_all(&[(RCC_APB1ENR, 0x1FF), (RCC_APB2ENR, 7 << 16 | 3)]);
        set(&mut rig, timer, &[(ARR, 15), (DIER, 1), (CR1, 1)]);
        assert_eq!(rig.next_event(), Time::from_us(1), "{timer:#x}");
        rig.advance(Time::from_us(1));
        assert_eq!(rig.irqs(), 1 << irq, "{timer:#x}");
        assert_eq!(rig.problems(), []);
    }
}

#[test]
fn in_one_pulse_mode_a_timer_stops_at_its_overflow() {
    let mut rig = counting(TIM2);
    set(&mut rig, TIM2, &[(ARR, 99), (CR1, 1 << 3 | 1)]);
    let after = Time::from_us(250);
    let [cr1, count, flags] = [CR1, CNT, SR].map(|register| rig.at(after).read(TIM2 + register));
    assert_eq!((cr1, count, flags & 1), (1 << 3, 0, 1));
    assert_eq!(rig.problems(), []);
}

#[test]
fn uses_of_a_timer_that_are_not_modelled_are_found() {
    const CCMR1: u32 = 0x18;
    const DMAR: u32 = 0x4C;
    for (register, value) in
        [(CR1, 1 << 4), (0x04, 1), (0x08, 1), (DIER, 1 << 8), (CCMR1, 1), (0x20, 1 << 2), (DMAR, 0)]
    {
        let mut rig = counting(TIM2);
        rig.write(TIM2 + register, value);
        assert_eq!(rig.problems(), [Problem::Unmodelled], "{register:#x}");
    }
    let mut rig = counting(TIM2);
    rig.at_us(50).write(TIM2 + ARR, 20);
    assert!(matches!(rig.problems()[..], [Problem::Misuse(_)]));
}

/// RM0090 7.2.11: HSE/RTC, the crystal divided by RTCPRE, is an input of TIM11.
#[test]
fn tim11_captures_the_crystal_in_ticks_of_hsi() {
    const TIM11: u32 = 0x4001_4800;
    const OVERCAPTURE: u32 = 1 << 9;
    for (hsi_ppm, ticks) in [(0, 992), (-80_000, 912), (45_000, 1_036)] {
        let variant = ChipVariant { hsi_ppm, ..ChipVariant::default() };
        let mut rig = Rig::with_variant(Part::Stm32f405, variant);
        rig.write_all(&[(RCC_APB2ENR, 1 << 18), (RCC_CR, 0x1_0083), (RCC_CFGR, 31 << 16)]);
        let start = Time::from_ms(5);
        rig.at(start).write_all(&[(TIM11 + 0x50, 2), (TIM11 + 0x18, 0b1101)]);
        rig.write_all(&[(TIM11 + 0x20, 1), (TIM11, 1)]);
        let mut capture = |us| {
            rig.at(start + Time::from_us(us));
            (rig.read(TIM11 + 0x10), rig.read(TIM11 + 0x34))
        };
        // 31 us for eight periods.
        let [first, second] = [40, 70].map(&mut capture);
        assert_eq!((first.0 & 0x202, second.0 & 0x202), (2, 2));
        assert!((second.1 - first.1).abs_diff(ticks / 2) <= 1, "{hsi_ppm}");
        assert_eq!(capture(400).0 & OVERCAPTURE, OVERCAPTURE);
        assert_eq!(rig.findings(), []);
    }
}
