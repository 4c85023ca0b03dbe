//! Clocks, supply, reset, pins and watchdog, and what any register has in common.

use emulator::{
    Time,
    chip::{ChipVariant, Part, Problem, ResetCause, Thresholds, Width},
};

use crate::rig::{
    FLASH_ACR, GPIOA, PWR_CR, RCC_AHB1ENR, RCC_APB1ENR, RCC_APB2ENR, RCC_CFGR, RCC_CR, RCC_CSR,
    RCC_PLLCFGR, Rig,
};

const IWDG: u32 = 0x4000_3000;
const PWR_CSR: u32 = 0x4000_7004;

/// Switches to HSE and PLL, 8 MHz / 4 * `n` / 2.
fn switch_to_pll(rig: &mut Rig, n: u32, wait_states: u32, prescalers: u32) {
    rig.write(FLASH_ACR, wait_states);
    rig.write_all(&[(RCC_CR, 0x0001_0083), (RCC_PLLCFGR, 1 << 22 | n << 6 | 4)]);
    rig.at(Time::from_ms(10)).write_all(&[(RCC_CR, 0x0101_0083), (RCC_CFGR, prescalers)]);
    rig.at(Time::from_ms(11)).write(RCC_CFGR, prescalers | 2);
}

/// At 128 MHz, with APB1 at 32 MHz, APB2 at 64 MHz, and four wait states.
fn at_128_mhz(part: Part) -> Rig {
    let mut rig = Rig::new(part);
    switch_to_pll(&mut rig, 128, 4, 4 << 13 | 5 << 10);
    rig
}

/// The problems of a PLL clock of 8 MHz / 4 * `n` / 2 with APB1 at an eighth and APB2 at a quarter of it.
fn problems_at(part: Part, n: u32, wait_states: u32, power: Option<u32>) -> Vec<Problem> {
    let mut rig = Rig::new(part);
    if let Some(power) = power {
        rig.write_all(&[(RCC_APB1ENR, 1 << 28), (PWR_CR, power)]);
    }
    switch_to_pll(&mut rig, n, wait_states, 5 << 13 | 6 << 10);
    rig.problems()
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
        let too_few = Problem::Misuse("too few flash wait states for this HCLK and supply");
        let found = problems_at(part, mhz, wait_states - 1, None);
        assert_eq!(found, [too_few], "{part:?} {mhz} MHz");
    }
}

#[test]
fn each_supply_has_its_own_number_of_wait_states_and_below_2_1_v_no_prefetch() {
    for (part, mv, mhz, wait_states) in [
        (Part::Stm32f405, 2_700, 160, 5),
        (Part::Stm32f405, 2_699, 160, 6),
        (Part::Stm32f446, 2_399, 160, 7),
        (Part::Stm32f405, 2_099, 160, 7),
        (Part::Stm32f412, 2_399, 80, 4),
    ] {
        let mut rig = Rig::new(part);
        rig.set_supply(mv);
        switch_to_pll(&mut rig, mhz, wait_states, 5 << 13 | 6 << 10);
        assert_eq!(rig.problems(), [], "{part:?} {mv} mV");
        let too_few = Problem::Misuse("too few flash wait states for this HCLK and supply");
        rig.write(FLASH_ACR, wait_states - 1);
        assert_eq!(rig.problems(), [too_few], "{part:?} {mv} mV");
    }
    let mut rig = Rig::new(Part::Stm32f405);
    rig.write(FLASH_ACR, 1 << 8);
    rig.set_supply(2_099);
    rig.check_supply(Time::ZERO);
    let prefetch = Problem::Misuse("prefetch of the flash at a supply below 2.1 V");
    assert_eq!(rig.problems(), [prefetch]);
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
fn a_crystal_is_ready_after_the_time_of_its_variant_or_never() {
    let ready = |hse_start: Time, after: Time| {
        let variant = ChipVariant { hse_start, ..ChipVariant::default() };
        let mut rig = Rig::with_variant(Part::Stm32f405, variant);
        rig.write(RCC_CR, 0x0001_0083);
        rig.at(after).read(RCC_CR) >> 17 & 1 == 1
    };
    for hse_start in [Time::from_us(100), Time::from_ms(10)] {
        assert!(!ready(hse_start, hse_start - Time::from_us(1)), "{hse_start}");
        assert!(ready(hse_start, hse_start), "{hse_start}");
    }
    assert!(!ready(Time::MAX, Time::from_s(100)));
}

#[test]
fn a_crystal_starts_without_hsebyp_and_an_external_clock_with_it() {
    const HSEON: u32 = 1 << 16;
    const HSEBYP: u32 = 1 << 18;
    let ms = |ms| Time::from_ms(ms);
    for external_clock in [false, true] {
        let variant = ChipVariant { external_clock, ..ChipVariant::default() };
        let mut rig = Rig::with_variant(Part::Stm32f405, variant);
        let ready = |rig: &mut Rig, at| rig.at(at).read(RCC_CR) & HSEON << 1 != 0;
        rig.write(RCC_CR, 0x83 | HSEON);
        assert_ne!(ready(&mut rig, ms(5)), external_clock);
        rig.write(RCC_CR, 0x83 | HSEON | HSEBYP);
        assert_ne!(ready(&mut rig, ms(10)), external_clock, "it changes only while HSE is off");
        rig.write(RCC_CR, 0x83);
        assert_ne!(ready(&mut rig, ms(10)), external_clock, "the flag falls some cycles later");
        rig.at(ms(11)).write(RCC_CR, 0x83 | HSEBYP);
        rig.write(RCC_CR, 0x83 | HSEON | HSEBYP);
        assert_eq!(ready(&mut rig, ms(15)), external_clock);
    }
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
        let mut rig = Rig::with_variant(Part::Stm32f405, variant);
        let low = |rig: &mut Rig| rig.read(PWR_CSR) >> 2 & 1 == 1;
        rig.write(RCC_APB1ENR, 1 << 28);
        rig.set_supply(1_900);
        assert!(!low(&mut rig), "it is off");
        for (pls, rising, falling) in levels {
            let (rising, falling) = (rising[place], falling[place]);
            rig.set_supply(rising - 1);
            rig.write_all(&[(PWR_CR, 0x4000), (PWR_CR, 0x4010 | pls << 5)]);
            for (mv, is_low) in [
                (rising - 1, true),
                (rising, false),
                (falling, false),
                (falling - 1, true),
                (rising - 1, true),
            ] {
                rig.set_supply(mv);
                assert_eq!(low(&mut rig), is_low, "{thresholds:?}, {pls}, {mv} mV");
            }
        }
        rig.set_supply(2_000);
        rig.reset(ResetCause::Software, Time::ZERO);
        rig.write_all(&[(RCC_APB1ENR, 1 << 28), (PWR_CR, 0x40B0)]);
        assert!(low(&mut rig), "a reset does not change the supply");
        assert_eq!(rig.findings(), []);
    }
}

#[test]
fn sysclk_does_not_follow_to_a_source_that_is_not_ready() {
    let mut rig = Rig::new(Part::Stm32f405);
    rig.write(RCC_CFGR, 1);
    assert_eq!(rig.clocks().sysclk.hz, 16_000_000);
    assert!(matches!(rig.problems()[0], Problem::Misuse(_)));
}

#[test]
fn too_few_wait_states_and_apb1_above_42_mhz_are_found_while_the_pll_runs() {
    for (register, value, problem) in [
        (FLASH_ACR, 3, "too few flash wait states for this HCLK and supply"),
        (RCC_CFGR, 4 << 13 | 4 << 10 | 2, "SYSCLK, APB1 or APB2 above the part's limit"),
    ] {
        let mut rig = at_128_mhz(Part::Stm32f407);
        rig.write(register, value);
        assert_eq!(rig.problems(), [Problem::Misuse(problem)]);
    }
}

#[test]
fn a_peripheral_without_clock_reads_0_loses_writes_and_is_found() {
    let mut rig = Rig::new(Part::Stm32f405);
    rig.write(GPIOA, 0x5555_5555);
    assert_eq!(rig.read(GPIOA), 0);
    assert_eq!(rig.problems(), [Problem::ClockOff; 2]);
    rig.write(RCC_AHB1ENR, 1);
    assert_eq!(rig.read(GPIOA), 0xA800_0000);
}

#[test]
fn an_unknown_register_is_found_once_and_counted() {
    let mut rig = Rig::new(Part::Stm32f405);
    for _ in 0..3 {
        assert_eq!(rig.at(Time::from_us(5)).read(0x4000_5400), 0);
    }
    let [finding] = rig.findings() else { panic!("{:?}", rig.findings()) };
    assert_eq!((finding.problem, finding.count, finding.pc), (Problem::Unmodelled, 3, 0x0800_1234));
    assert_eq!(
        finding.to_string(),
        "0.005000 ms, pc 08001234: 32-bit read of 40005400: not modelled (3 times)"
    );
}

#[test]
fn reset_flags_add_up_until_they_are_removed() {
    let mut rig = Rig::new(Part::Stm32f405);
    assert_eq!(rig.read(RCC_CSR), 0x0E00_0000);
    rig.reset(ResetCause::Software, Time::ZERO);
    assert_eq!(rig.read(RCC_CSR), 0x1E00_0000);
    rig.write(RCC_CSR, 1 << 24);
    assert_eq!(rig.read(RCC_CSR), 0);
    rig.reset(ResetCause::Watchdog, Time::ZERO);
    assert_eq!(rig.read(RCC_CSR), 0x2400_0000);
}

#[test]
fn a_fast_lsi_shortens_the_watchdog() {
    let variant = ChipVariant { lsi_hz: 47_000, ..ChipVariant::default() };
    let mut rig = Rig::with_variant(Part::Stm32f405, variant);
    rig.write(IWDG, 0xCCCC);
    assert_eq!(rig.next_event().as_us(), 4 * 4096 * 1_000_000 / 47_000);
}

#[test]
fn a_byte_on_apb_is_repeated_in_every_lane_and_one_on_ahb_is_not() {
    const SYSCFG_EXTICR1: u32 = 0x4001_3808;
    let mut rig = Rig::new(Part::Stm32f405);
    rig.write_all(&[(RCC_AHB1ENR, 1), (RCC_APB2ENR, 1 << 14)]);
    for (register, byte, value, word) in
        [(GPIOA + 0x14, 1, 0x81, 0x8100), (SYSCFG_EXTICR1, 0, 0x12, 0x1212_1212)]
    {
        rig.store(register + byte, Width::Byte, value).expect("no bus error");
        assert_eq!(rig.read(register), word);
    }
}

/// RM0090 4.4.
#[test]
fn the_crc_unit_needs_its_clock_and_whole_words() {
    const CRCEN: u32 = 1 << 12;
    const DR: u32 = 0x4002_3000;
    let mut rig = Rig::new(Part::Stm32f405);
    rig.write(DR, 0);
    rig.write(RCC_AHB1ENR, CRCEN);
    rig.store(DR, Width::Byte, 0).expect("no bus error");
    assert_eq!(rig.read(DR), u32::MAX);
    assert_eq!(rig.problems(), [Problem::ClockOff, Problem::Width]);
}
