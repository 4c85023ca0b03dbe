//! The registers of the timers as seen by a program, without a CPU.

use emulator::{
    Time,
    chip::{Part, Problem, Width},
};

use crate::rig::{RCC_APB1ENR, RCC_APB2ENR, Rig};

const TIM2: u32 = 0x4000_0000;
const CR1: u32 = 0x00;
const DIER: u32 = 0x0C;
const SR: u32 = 0x10;
const EGR: u32 = 0x14;
const CNT: u32 = 0x24;
const PSC: u32 = 0x28;
const ARR: u32 = 0x2C;
const CCR1: u32 = 0x34;
const CCR4: u32 = 0x40;

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
