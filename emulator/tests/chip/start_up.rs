//! Peripherals that start-up code of others touches: USART, RNG, RTC and the backup domain.

use emulator::{
    Time,
    chip::{Chip, Part, Problem, ResetCause},
};

use super::{PWR_CR, RCC_APB1ENR, chip, problems, read, write};

const RCC_AHB2ENR: u32 = 0x4002_3834;
const RCC_BDCR: u32 = 0x4002_3870;
const DBP: u32 = 1 << 8;
const RTC_TR: u32 = 0x4000_2800;
const RTC_DR: u32 = 0x4000_2804;
const RTC_ISR: u32 = 0x4000_280C;
const RTC_PRER: u32 = 0x4000_2810;
const RTC_WPR: u32 = 0x4000_2824;
const RTC_BKP0R: u32 = 0x4000_2850;

#[test]
fn a_usart_sends_the_bytes_of_an_enabled_transmitter() {
    const USART2: u32 = 0x4000_4400;
    const USART2_IRQ: u32 = 38;
    let mut chip = chip(Part::Stm32f405);
    write(&mut chip, RCC_APB1ENR, 1 << 17, Time::ZERO);
    write(&mut chip, USART2 + 4, b'?'.into(), Time::ZERO);
    assert_eq!(chip.take_sent().concat(), b"", "it is off");
    write(&mut chip, USART2 + 0x0C, 1 << 13 | 1 << 3, Time::ZERO);
    for byte in *b"hello" {
        assert_eq!(read(&mut chip, USART2, Time::ZERO), 0xC0, "TXE and TC");
        write(&mut chip, USART2 + 4, byte.into(), Time::ZERO);
    }
    assert_eq!(chip.take_sent()[1], b"hello");
    assert_eq!(chip.take_sent().concat(), b"");
    assert_eq!(chip.irqs(), 0);
    write(&mut chip, USART2 + 0x0C, 1 << 13 | 1 << 7 | 1 << 3, Time::ZERO);
    assert_eq!(chip.irqs(), 1 << USART2_IRQ);
    assert_eq!(problems(&chip), []);
}

#[test]
fn the_random_number_generator_gives_numbers_while_it_is_on() {
    const RNG: u32 = 0x5006_0800;
    let mut chip = chip(Part::Stm32f405);
    write(&mut chip, RCC_AHB2ENR, 1 << 6, Time::ZERO);
    assert_eq!(read(&mut chip, RNG + 4, Time::ZERO), 0, "no DRDY");
    write(&mut chip, RNG, 1 << 2, Time::ZERO);
    assert_eq!(read(&mut chip, RNG + 4, Time::ZERO), 1);
    let [a, b] = [(); 2].map(|()| read(&mut chip, RNG + 8, Time::ZERO));
    assert_ne!(a, b);
    assert_eq!(problems(&chip), []);
}

fn unlocked(chip: &mut Chip) {
    write(chip, RCC_APB1ENR, 1 << 28, Time::ZERO);
    write(chip, PWR_CR, DBP, Time::ZERO);
    for key in [0xCA, 0x53] {
        write(chip, RTC_WPR, key, Time::ZERO);
    }
}

#[test]
fn the_calendar_is_set_in_initialisation_mode_after_the_keys() {
    let mut chip = chip(Part::Stm32f405);
    unlocked(&mut chip);
    write(&mut chip, RTC_ISR, 1 << 7, Time::ZERO);
    assert_eq!(read(&mut chip, RTC_ISR, Time::ZERO) & 0xF0, 0xC0, "INIT and INITF");
    write(&mut chip, RTC_DR, 0x26_1122, Time::ZERO);
    write(&mut chip, RTC_TR, 0x12_3456, Time::ZERO);
    write(&mut chip, RTC_ISR, 0, Time::ZERO);
    assert_eq!(read(&mut chip, RTC_ISR, Time::ZERO) & 0xF0, 0x30, "RSF and INITS");
    write(&mut chip, RTC_WPR, 0xFF, Time::ZERO);
    assert_eq!(problems(&chip), []);
    write(&mut chip, RTC_TR, 0, Time::ZERO);
    assert!(matches!(problems(&chip)[..], [Problem::Misuse(_)]));
    assert_eq!(read(&mut chip, RTC_TR, Time::ZERO), 0x12_3456);
}

#[test]
fn the_calendar_counts_its_clock() {
    const RTC_SSR: u32 = 0x4000_2828;
    const RCC_CSR: u32 = 0x4002_3874;
    let mut chip = chip(Part::Stm32f405);
    unlocked(&mut chip);
    write(&mut chip, RCC_CSR, 1, Time::ZERO);
    write(&mut chip, RCC_BDCR, 1 << 15 | 2 << 8, Time::ZERO);
    write(&mut chip, RTC_ISR, 1 << 7, Time::ZERO);
    // LSI of 32 kHz, divided by 128 and by 250.
    for (register, value) in
        [(RTC_PRER, 0x007F_00F9), (RTC_TR, 0x23_5959), (RTC_DR, 0x28_4228), (RTC_ISR, 0)]
    {
        write(&mut chip, register, value, Time::ZERO);
    }
    let mut at = |ms| [RTC_TR, RTC_DR, RTC_SSR].map(|at| read(&mut chip, at, Time::from_ms(ms)));
    assert_eq!(at(0), [0x23_5959, 0x28_4228, 249]);
    assert_eq!(at(4), [0x23_5959, 0x28_4228, 248]);
    assert_eq!(at(999), [0x23_5959, 0x28_4228, 0]);
    assert_eq!(at(1_000), [0, 0x28_6229, 249], "29 February");
    assert_eq!(at(1_000 * (86_400 + 3_661)), [0x01_0100, 0x28_8301, 249], "1 March");
    assert_eq!(problems(&chip), []);
}

#[test]
fn the_backup_domain_is_protected_until_dbp_and_survives_all_but_power_on() {
    let mut chip = chip(Part::Stm32f405);
    write(&mut chip, RTC_BKP0R, 7, Time::ZERO);
    write(&mut chip, RCC_BDCR, 1 << 15, Time::ZERO);
    assert_eq!(problems(&chip).len(), 2);
    assert_eq!([RTC_BKP0R, RCC_BDCR].map(|at| read(&mut chip, at, Time::ZERO)), [0, 0]);
    unlocked(&mut chip);
    write(&mut chip, RTC_BKP0R, 7, Time::ZERO);
    write(&mut chip, RCC_BDCR, 1 << 15 | 2 << 8, Time::ZERO);
    chip.reset(ResetCause::Software, Time::ZERO);
    assert_eq!([RTC_BKP0R, RCC_BDCR].map(|at| read(&mut chip, at, Time::ZERO)), [7, 0x8200]);
    chip.reset(ResetCause::PowerOn, Time::ZERO);
    assert_eq!([RTC_BKP0R, RCC_BDCR].map(|at| read(&mut chip, at, Time::ZERO)), [0, 0]);
}

#[test]
fn the_clock_of_the_calendar_stays_selected_until_the_backup_domain_is_reset() {
    let mut chip = chip(Part::Stm32f405);
    unlocked(&mut chip);
    for (written, read_back) in [
        (2 << 8, 2 << 8),
        (0, 2 << 8),
        (1 << 15 | 3 << 8, 1 << 15 | 2 << 8),
        (1 << 16, 1 << 16),
        (3 << 8, 3 << 8),
    ] {
        write(&mut chip, RCC_BDCR, written, Time::ZERO);
        assert_eq!(read(&mut chip, RCC_BDCR, Time::ZERO), read_back, "{written:#x}");
    }
}

#[test]
fn a_crystal_for_the_clock_is_missing_on_the_board() {
    let mut chip = chip(Part::Stm32f405);
    unlocked(&mut chip);
    write(&mut chip, RCC_BDCR, 1, Time::ZERO);
    assert!(matches!(problems(&chip)[..], [Problem::Misuse(_)]));
    assert_eq!(read(&mut chip, RCC_BDCR, Time::from_s(10)), 1, "LSERDY stays 0");
}
