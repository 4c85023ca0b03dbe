//! The outputs of the timers, as a pin shows them.

use emulator::{
    Time,
    chip::{Part, Pin, Pwm},
};

use crate::rig::{GPIOA, RCC_AHB1ENR, RCC_APB1ENR, RCC_APB2ENR, Rig};

const TIM1: u32 = 0x4001_0000;
const TIM3: u32 = 0x4000_0400;
const CR1: u32 = 0x00;
const EGR: u32 = 0x14;
const CCMR1: u32 = 0x18;
const CCER: u32 = 0x20;
const PSC: u32 = 0x28;
const ARR: u32 = 0x2C;
const CCR1: u32 = 0x34;
const CCR2: u32 = 0x38;
const BDTR: u32 = 0x44;

const PWM_MODE_1: u32 = 0x68;
const ARPE_CEN: u32 = 1 << 7 | 1;

/// Periods of 1 ms in steps of 1 us, at 16 MHz, on PA6: TIM3; and PA8: TIM1.
fn running(timer: u32, high_us: u32) -> Rig {
    let mut rig = Rig::new(Part::Stm32f446);
    rig.write_all(&[(RCC_AHB1ENR, 1), (RCC_APB1ENR, 2), (RCC_APB2ENR, 1)]);
    rig.write_all(&[(GPIOA, 0xA800_0000 | 2 << 12 | 2 << 16), (GPIOA + 0x20, 2 << 24)]);
    rig.write(GPIOA + 0x24, 1);
    for (register, value) in [
        (CR1, 1 << 7),
        (PSC, 15),
        (ARR, 999),
        (EGR, 1),
        (CCMR1, PWM_MODE_1),
        (CCR1, high_us),
        (CCER, 1),
        (CR1, ARPE_CEN),
    ] {
        rig.write(timer + register, value);
    }
    rig
}

fn at_pin(rig: &mut Rig, pin: u8) -> Option<Pwm> {
    let now = rig.now;
    rig.pwm(Pin('A', pin), now)
}

fn pwm(period_us: u64, high_us: u64) -> Option<Pwm> {
    Some(Pwm { period: Time::from_us(period_us), high: Time::from_us(high_us) })
}

#[test]
fn a_pin_shows_the_frequency_and_the_duty_cycle_of_its_timer() {
    let mut rig = running(TIM3, 250);
    let seen = at_pin(&mut rig, 6);
    assert_eq!(seen, pwm(1_000, 250));
    assert_eq!(seen.map(|seen| (seen.hz(), seen.percent())), Some((1_000.0, 25.0)));
    for (writes, expected) in [
        (&[(CCR1, 0)][..], pwm(1_000, 0)),
        (&[(CCR1, 2_000)], pwm(1_000, 1_000)),
        (&[(CCR1, 100), (CCER, 3)], pwm(1_000, 900)),
        (&[(CCMR1, 0x78)], pwm(1_000, 100)),
        (&[(CCMR1, 0x30), (CCER, 1)], pwm(2_000, 1_000)),
        (&[(CCER, 0)], None),
        (&[(CCER, 1), (CR1, 0)], None),
    ] {
        writes.iter().for_each(|(register, value)| rig.write(TIM3 + register, *value));
        assert_eq!(at_pin(&mut rig, 6), expected, "{writes:x?}");
    }
    assert_eq!(rig.problems(), []);
}

#[test]
fn a_pin_in_another_function_shows_no_waveform() {
    let mut rig = running(TIM3, 250);
    assert_eq!((at_pin(&mut rig, 7), at_pin(&mut rig, 8)), (None, None));
    rig.write(GPIOA + 0x20, 5 << 24);
    assert_eq!(at_pin(&mut rig, 6), None);
}

#[test]
fn the_next_pin_shows_the_next_channel() {
    let mut rig = running(TIM3, 250);
    rig.write_all(&[(GPIOA, 0xA800_0000 | 0xA << 12), (GPIOA + 0x20, 0x22 << 24)]);
    for (register, value) in [(CCMR1, PWM_MODE_1 << 8 | PWM_MODE_1), (CCR2, 600), (CCER, 0x11)] {
        rig.write(TIM3 + register, value);
    }
    assert_eq!((at_pin(&mut rig, 6), at_pin(&mut rig, 7)), (pwm(1_000, 250), pwm(1_000, 600)));
}

#[test]
fn tim1_has_outputs_only_with_moe_or_aoe() {
    let mut rig = running(TIM1, 500);
    assert_eq!(at_pin(&mut rig, 8), None);
    for bit in [1 << 15, 1 << 14] {
        rig.write(TIM1 + BDTR, bit);
        assert_eq!(at_pin(&mut rig, 8), pwm(1_000, 500));
    }
    assert_eq!(rig.problems(), []);
}

#[test]
fn a_preloaded_period_begins_with_the_next_one() {
    let mut rig = running(TIM3, 250);
    rig.at_us(300).write(TIM3 + ARR, 499);
    assert_eq!((rig.read(TIM3 + ARR), at_pin(&mut rig, 6)), (499, pwm(1_000, 250)));
    rig.at_us(999);
    assert_eq!(at_pin(&mut rig, 6), pwm(1_000, 250));
    rig.at_us(1_001);
    assert_eq!(at_pin(&mut rig, 6), pwm(500, 250));
    rig.write(TIM3 + PSC, 31);
    assert_eq!(at_pin(&mut rig, 6), pwm(500, 250));
    assert_eq!(rig.at_us(1_600).read(TIM3 + 0x24), 50, "since 1.5 ms, in steps of 2 us");
    assert_eq!(at_pin(&mut rig, 6), pwm(1_000, 500));
    assert_eq!(rig.problems(), []);
}
