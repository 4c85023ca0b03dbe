//! The registers of ADC1 as seen by a program, without a CPU.

use emulator::{
    Time,
    can::Clock,
    chip::{Chip, Part, Problem, Width},
};

use super::{access, problems, read, write};

const RCC_APB2ENR: u32 = 0x4002_3844;
const SR: u32 = 0x4001_2000;
const CR2: u32 = 0x4001_2008;
const SMPR1: u32 = 0x4001_200C;
const SQR3: u32 = 0x4001_2034;
const DR: u32 = 0x4001_204C;
const CCR: u32 = 0x4001_2304;
const REFERENCE_CALIBRATION: u32 = 0x1FFF_7A2A;
const SENSOR_CALIBRATION: u32 = 0x1FFF_7A2C;

const ADON: u32 = 1 << 0;
const SWSTART: u32 = 1 << 30;
const TSVREFE: u32 = 1 << 23;
const EOC: u32 = 1 << 1;

/// A chip at 16 MHz that has begun to convert `channel` at time zero, with 480 cycles of sampling from channel 10 on.
fn converting(part: Part, channel: u32, set_up: impl Fn(&mut Chip)) -> Chip {
    let mut chip = Chip::new(part, Clock { hz: 8_000_000, ppm: 0 }, [0; 12]);
    set_up(&mut chip);
    write(&mut chip, RCC_APB2ENR, 1 << 8, Time::ZERO);
    write(&mut chip, CCR, TSVREFE, Time::ZERO);
    write(&mut chip, SMPR1, 0x07FF_FFFF, Time::ZERO);
    write(&mut chip, SQR3, channel, Time::ZERO);
    write(&mut chip, CR2, ADON, Time::ZERO);
    write(&mut chip, CR2, ADON | SWSTART, Time::ZERO);
    chip
}

fn sample(mut chip: Chip) -> u32 {
    read(&mut chip, DR, Time::from_ms(1))
}

#[test]
fn a_conversion_takes_its_sampling_time_and_twelve_cycles() {
    let mut chip = converting(Part::Stm32f405, 16, |_| {});
    // The converter runs at half of APB2.
    let end = Time::from_ns((480 + 12) * 125);
    assert_eq!(read(&mut chip, SR, end - Time::from_ns(1)) & EOC, 0);
    assert_eq!(read(&mut chip, SR, end) & EOC, EOC);
    read(&mut chip, DR, end);
    assert_eq!(read(&mut chip, SR, end) & EOC, 0, "reading the data clears it");
    assert!(chip.findings().is_empty());
}

#[test]
fn a_channel_measures_its_voltage_against_the_supply() {
    let at = |mv| {
        sample(converting(Part::Stm32f405, 3, |chip| {
            chip.adc_mut().analogue.channels_mv[3] = mv;
        }))
    };
    assert_eq!([0, 1_500, 3_000, 5_000].map(at), [0, 2_047, 4_095, 4_095]);
}

#[test]
fn the_sensor_and_its_calibration_give_the_temperature() {
    for (part, channel) in [(Part::Stm32f405, 16), (Part::Stm32f412, 18), (Part::Stm32f446, 18)] {
        for celsius in [-40, 25, 85] {
            let mut chip = converting(part, channel, |chip| {
                chip.adc_mut().analogue.temperature = celsius;
                chip.adc_mut().analogue.supply_mv = 3_300;
            });
            let mut calibration = |offset| {
                let access = access(SENSOR_CALIBRATION + offset, Width::Half, Time::ZERO);
                chip.read(access).expect("no bus error") as i32
            };
            let (at_30, at_110) = (calibration(0), calibration(2));
            let sample = sample(chip) as i32;
            let measured = 30 + 80 * (sample - at_30) / (at_110 - at_30);
            assert!((measured - celsius).abs() <= 1, "{part:?}: {measured} instead of {celsius}");
        }
    }
}

#[test]
fn the_reference_shows_the_supply() {
    let mut chip = converting(Part::Stm32f405, 17, |chip| {
        chip.adc_mut().analogue.supply_mv = 2_800;
    });
    let calibration = access(REFERENCE_CALIBRATION, Width::Half, Time::ZERO);
    let at_3300 = chip.read(calibration).expect("no bus error");
    let supply_mv = 3_300 * at_3300 / sample(chip);
    assert!(supply_mv.abs_diff(2_800) <= 2, "{supply_mv} mV");
}

#[test]
fn a_conversion_while_the_adc_is_off_is_found() {
    let mut chip = Chip::new(Part::Stm32f405, Clock { hz: 8_000_000, ppm: 0 }, [0; 12]);
    write(&mut chip, RCC_APB2ENR, 1 << 8, Time::ZERO);
    write(&mut chip, CR2, SWSTART, Time::ZERO);
    assert_eq!(problems(&chip), [Problem::Misuse("a conversion is started while the ADC is off")]);
}
