//! The registers of ADC1 as seen by a program, without a CPU.

use emulator::{
    Time,
    chip::{Analogue, Part, Problem},
};

use crate::rig::{RCC_APB2ENR, Rig};

const SR: u32 = 0x4001_2000;
const CR2: u32 = 0x4001_2008;
const SMPR1: u32 = 0x4001_200C;
const SQR3: u32 = 0x4001_2034;
const DR: u32 = 0x4001_204C;
const CCR: u32 = 0x4001_2304;

const ADON: u32 = 1 << 0;
const SWSTART: u32 = 1 << 30;
const TSVREFE: u32 = 1 << 23;
const EOC: u32 = 1 << 1;

/// A chip at 16 MHz that has begun to convert `channel` at time zero, with 480 cycles of sampling from channel 10 on.
fn converting(part: Part, channel: u32, set_up: impl Fn(&mut Analogue)) -> Rig {
    let mut rig = Rig::new(part);
    set_up(&mut rig.adc_mut().analogue);
    rig.write_all(&[(RCC_APB2ENR, 1 << 8), (CCR, TSVREFE), (SMPR1, 0x07FF_FFFF), (SQR3, channel)]);
    rig.write_all(&[(CR2, ADON), (CR2, ADON | SWSTART)]);
    rig
}

fn sample(rig: &mut Rig) -> u32 {
    rig.at(Time::from_ms(1)).read(DR)
}

#[test]
fn a_conversion_takes_its_sampling_time_and_twelve_cycles() {
    let mut rig = converting(Part::Stm32f405, 16, |_| {});
    // The converter runs at half of APB2.
    let end = Time::from_ns((480 + 12) * 125);
    assert_eq!(rig.at(end - Time::from_ns(1)).read(SR) & EOC, 0);
    assert_eq!(rig.at(end).read(SR) & EOC, EOC);
    rig.read(DR);
    assert_eq!(rig.read(SR) & EOC, 0, "reading the data clears it");
    assert!(rig.findings().is_empty());
}

#[test]
fn a_channel_measures_its_voltage_against_the_supply() {
    let at = |mv| sample(&mut converting(Part::Stm32f405, 3, |world| world.channels_mv[3] = mv));
    assert_eq!([0, 1_500, 3_000, 5_000].map(at), [0, 2_047, 4_095, 4_095]);
}

#[test]
fn a_conversion_while_the_adc_is_off_is_found() {
    let mut rig = Rig::new(Part::Stm32f405);
    rig.write_all(&[(RCC_APB2ENR, 1 << 8), (CR2, SWSTART)]);
    assert_eq!(rig.problems(), [Problem::Misuse("a conversion is started while the ADC is off")]);
}
