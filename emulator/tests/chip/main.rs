//! The chip's registers as seen by a program, without a CPU.

mod adc;
mod start_up;
mod timer;

use emulator::{
    Time,
    can::Clock,
    chip::{Access, Chip, ChipVariant, Part, Pin, Problem, Request, ResetCause, Thresholds, Width},
};

const RCC_CR: u32 = 0x4002_3800;
const RCC_PLLCFGR: u32 = 0x4002_3804;
const RCC_CFGR: u32 = 0x4002_3808;
const RCC_CIR: u32 = 0x4002_380C;
const RCC_AHB1ENR: u32 = 0x4002_3830;
const RCC_APB1ENR: u32 = 0x4002_3840;
const RCC_CSR: u32 = 0x4002_3874;
const FLASH_ACR: u32 = 0x4002_3C00;
const GPIOA: u32 = 0x4002_0000;
const IWDG: u32 = 0x4000_3000;
const PWR_CR: u32 = 0x4000_7000;
const PWR_CSR: u32 = 0x4000_7004;

fn chip(part: Part) -> Chip {
    Chip::new(part, Clock { hz: 8_000_000, ppm: 20 }, *b"unique id 12")
}

fn chip_with(part: Part, variant: ChipVariant) -> Chip {
    Chip::with_variant(part, Clock { hz: 8_000_000, ppm: 20 }, *b"unique id 12", variant)
}

fn access(address: u32, width: Width, now: Time) -> Access {
    Access { address, width, now, pc: 0x0800_1234 }
}

fn read(chip: &mut Chip, address: u32, now: Time) -> u32 {
    chip.read(access(address, Width::Word, now)).expect("no bus error")
}

fn write(chip: &mut Chip, address: u32, value: u32, now: Time) {
    chip.write(access(address, Width::Word, now), value).expect("no bus error");
}

fn problems(chip: &Chip) -> Vec<Problem> {
    chip.findings().iter().map(|finding| finding.problem).collect()
}

/// HSE, PLL 8 MHz / 4 * 128 / 2 = 128 MHz, APB1 32 MHz, APB2 64 MHz, four wait states.
fn to_128_mhz(chip: &mut Chip) {
    let ready = Time::from_ms(10);
    write(chip, FLASH_ACR, 4, Time::ZERO);
    write(chip, RCC_CR, 0x0001_0083, Time::ZERO);
    write(chip, RCC_PLLCFGR, 1 << 22 | 128 << 6 | 4, Time::ZERO);
    write(chip, RCC_CR, 0x0101_0083, ready);
    write(chip, RCC_CFGR, 4 << 13 | 5 << 10, ready);
    write(chip, RCC_CFGR, 4 << 13 | 5 << 10 | 2, ready + Time::from_ms(1));
}

#[test]
fn the_pll_makes_128_mhz_and_32_mhz_with_the_crystals_error() {
    for part in Part::ALL.into_iter().filter(|part| part.clock_limits().0 > 128_000_000) {
        let mut chip = chip(part);
        to_128_mhz(&mut chip);
        let clocks = chip.clocks();
        assert_eq!(clocks.hclk, Clock { hz: 128_000_000, ppm: 20 });
        assert_eq!(clocks.pclk1, Clock { hz: 32_000_000, ppm: 20 });
        assert_eq!(clocks.pclk2, Clock { hz: 64_000_000, ppm: 20 });
        assert_eq!(read(&mut chip, RCC_CFGR, Time::from_s(1)) & 0xF, 0b1010);
        assert_eq!(chip.findings(), []);
    }
}

/// The problems of a PLL clock of 8 MHz / 4 * `n` / 2 with APB1 at an eighth and APB2 at a quarter of it.
fn problems_at(part: Part, n: u32, wait_states: u32, power: Option<u32>) -> Vec<Problem> {
    let mut chip = chip(part);
    let ready = Time::from_ms(10);
    if let Some(power) = power {
        write(&mut chip, RCC_APB1ENR, 1 << 28, Time::ZERO);
        write(&mut chip, PWR_CR, power, Time::ZERO);
    }
    write(&mut chip, FLASH_ACR, wait_states, Time::ZERO);
    write(&mut chip, RCC_CR, 0x0001_0083, Time::ZERO);
    write(&mut chip, RCC_PLLCFGR, 1 << 22 | n << 6 | 4, Time::ZERO);
    write(&mut chip, RCC_CR, 0x0101_0083, ready);
    write(&mut chip, RCC_CFGR, 5 << 13 | 6 << 10, ready);
    write(&mut chip, RCC_CFGR, 5 << 13 | 6 << 10 | 2, ready + Time::from_ms(1));
    problems(&chip)
}

#[test]
fn each_manual_has_its_own_number_of_wait_states() {
    for (part, mhz, wait_states) in [
        (Part::Stm32f405, 150, 4),
        (Part::Stm32f405, 160, 5),
        (Part::Stm32f412, 64, 1),
        (Part::Stm32f412, 80, 2),
        (Part::Stm32f413, 75, 2),
        (Part::Stm32f413, 80, 3),
        (Part::Stm32f469, 160, 5),
    ] {
        assert_eq!(problems_at(part, mhz, wait_states, None), [], "{part:?} {mhz} MHz");
        let too_few = Problem::Misuse("too few flash wait states for this HCLK");
        let found = problems_at(part, mhz, wait_states - 1, None);
        assert_eq!(found, [too_few], "{part:?} {mhz} MHz");
    }
}

#[test]
fn a_clock_above_the_voltage_scale_is_found() {
    let too_fast = Problem::Misuse("HCLK above the limit of the voltage scale (PWR_CR.VOS)");
    for (part, power, mhz) in [
        (Part::Stm32f405, Some(0), 144),
        (Part::Stm32f405, None, 168),
        (Part::Stm32f412, Some(0x4000), 64),
        (Part::Stm32f412, None, 84),
        (Part::Stm32f423, Some(0xC000), 100),
        (Part::Stm32f429, Some(0x4000), 120),
        (Part::Stm32f446, Some(0x8000), 144),
        (Part::Stm32f479, None, 168),
    ] {
        assert_eq!(problems_at(part, mhz, 7, power), [], "{part:?} {power:?} {mhz} MHz");
        let is_highest = mhz * 1_000_000 == part.clock_limits().0;
        let found = problems_at(part, mhz + 2, 7, power);
        if is_highest {
            assert!(!found.is_empty(), "{part:?}");
        } else {
            assert_eq!(found, [too_fast], "{part:?} {power:?}");
        }
    }
}

#[test]
fn a_part_of_100_mhz_starts_at_voltage_scale_2() {
    for part in [Part::Stm32f412, Part::Stm32f413, Part::Stm32f423] {
        let mut chip = chip(part);
        write(&mut chip, RCC_APB1ENR, 1 << 28, Time::ZERO);
        assert_eq!(read(&mut chip, PWR_CR, Time::ZERO), 0x8000, "{part:?}");
    }
}

#[test]
fn a_crystal_is_ready_after_the_time_of_its_variant_or_never() {
    let ready = |hse_start: Time, after: Time| {
        let variant = ChipVariant { hse_start, ..ChipVariant::default() };
        let mut chip = chip_with(Part::Stm32f405, variant);
        write(&mut chip, RCC_CR, 0x0001_0083, Time::ZERO);
        read(&mut chip, RCC_CR, after) >> 17 & 1 == 1
    };
    for hse_start in [Time::from_us(100), Time::from_ms(10)] {
        assert!(!ready(hse_start, hse_start - Time::from_us(1)), "{hse_start}");
        assert!(ready(hse_start, hse_start), "{hse_start}");
    }
    assert!(!ready(Time::MAX, Time::from_s(100)));
}

#[test]
fn with_clock_security_a_crystal_that_stops_leaves_hsi_and_interrupts() {
    let mut chip = chip(Part::Stm32f405);
    to_128_mhz(&mut chip);
    let now = Time::from_s(1);
    write(&mut chip, RCC_CR, 0x0109_0083, now);
    assert!(!chip.nmi());
    chip.stop_crystal(now);
    assert_eq!((chip.nmi(), chip.is_stopped()), (true, false));
    // The prescalers keep their values: APB1 runs at a quarter of 16 MHz.
    assert_eq!((chip.clocks().hclk.hz, chip.clocks().pclk1.hz), (16_000_000, 4_000_000));
    assert_eq!(read(&mut chip, RCC_CR, now) & 0x0303_0003, 0x0000_0003);
    assert_eq!(read(&mut chip, RCC_CIR, now), 1 << 7);
    write(&mut chip, RCC_CIR, 1 << 23, now);
    assert!(!chip.nmi());
    let later = Time::from_s(2);
    write(&mut chip, RCC_CR, 0x0009_0083, now);
    assert_eq!(read(&mut chip, RCC_CR, later) >> 17 & 1, 0, "it does not work");
    chip.start_crystal(later);
    assert_eq!(read(&mut chip, RCC_CR, later + Time::from_ms(2)) >> 17 & 1, 1);
    assert_eq!(chip.findings(), []);
}

#[test]
fn without_clock_security_a_crystal_that_stops_stops_the_chip() {
    let mut chip = chip(Part::Stm32f405);
    to_128_mhz(&mut chip);
    chip.stop_crystal(Time::from_s(1));
    assert_eq!((chip.nmi(), chip.is_stopped()), (false, true));
    chip.reset(ResetCause::Watchdog, Time::from_s(2));
    assert!(!chip.is_stopped());
}

#[test]
fn the_voltage_detector_compares_the_supply_with_the_chosen_level() {
    // PLS, then the rising and the falling level of the lowest, the typical and the highest chip.
    let levels = [
        (0, [2_090, 2_140, 2_190], [1_980, 2_040, 2_080]),
        (4, [2_700, 2_760, 2_820], [2_590, 2_660, 2_710]),
        (5, [2_860, 2_930, 2_990], [2_750, 2_840, 2_920]),
        (7, [3_070, 3_140, 3_210], [2_950, 3_030, 3_090]),
    ];
    for (place, thresholds) in
        [Thresholds::Lowest, Thresholds::Typical, Thresholds::Highest].into_iter().enumerate()
    {
        let variant = ChipVariant { thresholds, ..ChipVariant::default() };
        let mut chip = chip_with(Part::Stm32f405, variant);
        let low = |chip: &mut Chip| read(chip, PWR_CSR, Time::ZERO) >> 2 & 1 == 1;
        write(&mut chip, RCC_APB1ENR, 1 << 28, Time::ZERO);
        chip.set_supply(1_900);
        assert!(!low(&mut chip), "it is off");
        for (pls, rising, falling) in levels {
            let (rising, falling) = (rising[place], falling[place]);
            chip.set_supply(rising - 1);
            write(&mut chip, PWR_CR, 0x4000, Time::ZERO);
            write(&mut chip, PWR_CR, 0x4010 | pls << 5, Time::ZERO);
            for (mv, is_low) in [
                (rising - 1, true),
                (rising, false),
                (falling, false),
                (falling - 1, true),
                (rising - 1, true),
            ] {
                chip.set_supply(mv);
                assert_eq!(low(&mut chip), is_low, "{thresholds:?}, {pls}, {mv} mV");
            }
        }
        chip.set_supply(2_000);
        chip.reset(ResetCause::Software, Time::ZERO);
        write(&mut chip, RCC_APB1ENR, 1 << 28, Time::ZERO);
        write(&mut chip, PWR_CR, 0x40B0, Time::ZERO);
        assert!(low(&mut chip), "a reset does not change the supply");
        assert_eq!(chip.findings(), []);
    }
}

#[test]
fn sysclk_does_not_follow_to_a_source_that_is_not_ready() {
    let mut chip = chip(Part::Stm32f405);
    write(&mut chip, RCC_CFGR, 1, Time::ZERO);
    assert_eq!(chip.clocks().sysclk.hz, 16_000_000);
    assert!(matches!(chip.findings()[0].problem, Problem::Misuse(_)));
}

#[test]
fn too_few_flash_wait_states_are_found() {
    let mut chip = chip(Part::Stm32f405);
    to_128_mhz(&mut chip);
    write(&mut chip, FLASH_ACR, 3, Time::from_s(1));
    let finding = &chip.findings()[0];
    assert_eq!(finding.problem.to_string(), "too few flash wait states for this HCLK");
}

#[test]
fn apb1_above_42_mhz_is_found() {
    let mut chip = chip(Part::Stm32f407);
    to_128_mhz(&mut chip);
    write(&mut chip, RCC_CFGR, 4 << 13 | 4 << 10 | 2, Time::from_s(1));
    assert_eq!(chip.findings().len(), 1);
}

#[test]
fn a_peripheral_without_clock_reads_0_loses_writes_and_is_found() {
    let mut chip = chip(Part::Stm32f405);
    write(&mut chip, GPIOA, 0x5555_5555, Time::ZERO);
    assert_eq!(read(&mut chip, GPIOA, Time::ZERO), 0);
    assert_eq!(chip.findings().len(), 2);
    assert!(chip.findings().iter().all(|finding| finding.problem == Problem::ClockOff));
    write(&mut chip, RCC_AHB1ENR, 1, Time::ZERO);
    assert_eq!(read(&mut chip, GPIOA, Time::ZERO), 0xA800_0000);
}

#[test]
fn an_unknown_register_is_found_once_and_counted() {
    let mut chip = chip(Part::Stm32f405);
    for _ in 0..3 {
        assert_eq!(read(&mut chip, 0x4000_3800, Time::from_us(5)), 0);
    }
    let [finding] = chip.findings() else { panic!("{:?}", chip.findings()) };
    assert_eq!((finding.problem, finding.count, finding.pc), (Problem::Unmodelled, 3, 0x0800_1234));
    assert_eq!(
        finding.to_string(),
        "0.005000 ms, pc 08001234: 32-bit read of 40003800: not modelled (3 times)"
    );
}

#[test]
fn reset_flags_add_up_until_they_are_removed() {
    let mut chip = chip(Part::Stm32f405);
    assert_eq!(read(&mut chip, RCC_CSR, Time::ZERO), 0x0E00_0000);
    chip.reset(ResetCause::Software, Time::ZERO);
    assert_eq!(read(&mut chip, RCC_CSR, Time::ZERO), 0x1E00_0000);
    write(&mut chip, RCC_CSR, 1 << 24, Time::ZERO);
    assert_eq!(read(&mut chip, RCC_CSR, Time::ZERO), 0);
    chip.reset(ResetCause::Watchdog, Time::ZERO);
    assert_eq!(read(&mut chip, RCC_CSR, Time::ZERO), 0x2400_0000);
}

#[test]
fn an_output_keeps_the_time_of_its_last_change() {
    let mut chip = chip(Part::Stm32f405);
    let pin = Pin('A', 5);
    let (high, low) = (Time::from_ms(2), Time::from_ms(5));
    write(&mut chip, RCC_AHB1ENR, 1, Time::ZERO);
    assert_eq!(chip.gpio().output(pin).level, None);
    write(&mut chip, GPIOA, 0xA800_0400, Time::from_ms(1));
    assert_eq!(chip.gpio().output(pin).level, Some(false));
    write(&mut chip, GPIOA + 0x18, 1 << 5, high);
    write(&mut chip, GPIOA + 0x18, 1 << 5 | 1 << 6, Time::from_ms(3));
    assert_eq!((chip.gpio().output(pin).level, chip.gpio().output(pin).since), (Some(true), high));
    write(&mut chip, GPIOA + 0x18, 1 << 21, low);
    assert_eq!((chip.gpio().output(pin).level, chip.gpio().output(pin).since), (Some(false), low));
}

#[test]
fn an_input_reads_its_pull_until_something_is_connected() {
    let mut chip = chip(Part::Stm32f405);
    write(&mut chip, RCC_AHB1ENR, 1, Time::ZERO);
    write(&mut chip, GPIOA + 0x0C, 0x6400_0001, Time::ZERO);
    assert_eq!(read(&mut chip, GPIOA + 0x10, Time::ZERO) & 1, 1);
    chip.gpio_mut().set_input(Pin('A', 0), Some(false));
    assert_eq!(read(&mut chip, GPIOA + 0x10, Time::ZERO) & 1, 0);
}

#[test]
fn the_watchdog_runs_out_after_its_periods_of_lsi() {
    let mut chip = chip(Part::Stm32f405);
    let start = Time::from_ms(7);
    write(&mut chip, IWDG, 0x5555, start);
    write(&mut chip, IWDG + 4, 3, start);
    write(&mut chip, IWDG + 8, 999, start);
    assert_eq!(read(&mut chip, IWDG + 12, start), 3);
    write(&mut chip, IWDG, 0xCCCC, start);
    // The first count is from 4095, at 32 kHz / 32; then 1000 periods.
    assert_eq!(chip.next_event(), start + Time::from_ms(4096));
    write(&mut chip, IWDG, 0xAAAA, start + Time::from_ms(400));
    assert_eq!(chip.next_event(), start + Time::from_ms(1400));
    chip.advance(start + Time::from_ms(1400));
    assert_eq!(chip.take_request(), Some(Request::Reset(ResetCause::Watchdog)));
    assert_eq!(read(&mut chip, IWDG + 12, start + Time::from_ms(1)), 0);
    assert_eq!(chip.findings(), []);
}

#[test]
fn a_fast_lsi_shortens_the_watchdog() {
    let variant = ChipVariant { lsi_hz: 47_000, ..ChipVariant::default() };
    let mut chip = chip_with(Part::Stm32f405, variant);
    write(&mut chip, IWDG, 0xCCCC, Time::ZERO);
    assert_eq!(chip.next_event().as_us(), 4 * 4096 * 1_000_000 / 47_000);
}

#[test]
fn a_byte_on_apb_is_repeated_in_every_lane_and_one_on_ahb_is_not() {
    let mut chip = chip(Part::Stm32f405);
    write(&mut chip, RCC_AHB1ENR, 1, Time::ZERO);
    chip.write(access(GPIOA + 0x15, Width::Byte, Time::ZERO), 0x81).expect("no bus error");
    assert_eq!(read(&mut chip, GPIOA + 0x14, Time::ZERO), 0x8100);
    write(&mut chip, 0x4002_3844, 1 << 14, Time::ZERO);
    chip.write(access(0x4001_3808, Width::Byte, Time::ZERO), 0x12).expect("no bus error");
    assert_eq!(read(&mut chip, 0x4001_3808, Time::ZERO), 0x1212_1212);
}

#[test]
fn the_factory_data_is_readable_in_any_width() {
    for part in Part::ALL {
        let mut chip = chip(part);
        assert_eq!(read(&mut chip, 0x1FFF_7A10, Time::ZERO).to_le_bytes(), *b"uniq");
        assert_eq!(read(&mut chip, 0x1FFF_7A18, Time::ZERO).to_le_bytes(), *b"d 12");
        let size = chip.read(access(0x1FFF_7A22, Width::Half, Time::ZERO)).expect("no bus error");
        assert_eq!(size * 1024, part.flash_size());
        assert_eq!(read(&mut chip, 0xE004_2000, Time::ZERO), part.id_code());
        assert_eq!(chip.findings(), []);
    }
}

#[test]
fn a_reset_through_rcc_puts_can_back_to_sleep() {
    let mut chip = chip(Part::Stm32f405);
    write(&mut chip, RCC_APB1ENR, 1 << 25, Time::ZERO);
    write(&mut chip, 0x4000_6400, 1, Time::ZERO);
    assert_eq!(read(&mut chip, 0x4000_6400, Time::ZERO), 1);
    write(&mut chip, RCC_APB1ENR - 0x20, 1 << 25, Time::ZERO);
    write(&mut chip, RCC_APB1ENR - 0x20, 0, Time::ZERO);
    assert_eq!(read(&mut chip, 0x4000_6400, Time::ZERO), 0x0001_0002);
}
