//! The backup domain, which start-up code of others touches.

use emulator::{
    Time,
    chip::{Part, Problem, ResetCause},
};

use crate::rig::{PWR_CR, RCC_APB1ENR, Rig};

const RCC_BDCR: u32 = 0x4002_3870;
const DBP: u32 = 1 << 8;

fn unlock(rig: &mut Rig) {
    rig.write_all(&[(RCC_APB1ENR, 1 << 28), (PWR_CR, DBP)]);
}

#[test]
fn the_backup_domain_is_protected_until_dbp_and_survives_all_but_power_on() {
    let mut rig = Rig::new(Part::Stm32f405);
    rig.write(RCC_BDCR, 1 << 15);
    assert!(matches!(rig.problems()[..], [Problem::Misuse(_)]));
    assert_eq!(rig.read(RCC_BDCR), 0);
    unlock(&mut rig);
    rig.write(RCC_BDCR, 1 << 15 | 2 << 8);
    rig.reset(ResetCause::Software, Time::ZERO);
    assert_eq!(rig.read(RCC_BDCR), 0x8200);
    rig.reset(ResetCause::PowerOn, Time::ZERO);
    assert_eq!(rig.read(RCC_BDCR), 0);
}

#[test]
fn the_clock_of_the_calendar_stays_selected_until_the_backup_domain_is_reset() {
    let mut rig = Rig::new(Part::Stm32f405);
    unlock(&mut rig);
    for (written, read_back) in [
        (2 << 8, 2 << 8),
        (0, 2 << 8),
        (1 << 15 | 3 << 8, 1 << 15 | 2 << 8),
        (1 << 16, 1 << 16),
        (3 << 8, 3 << 8),
    ] {
        rig.write(RCC_BDCR, written);
        assert_eq!(rig.read(RCC_BDCR), read_back, "{written:#x}");
    }
}

#[test]
fn a_crystal_for_the_clock_is_missing_on_the_board() {
    let mut rig = Rig::new(Part::Stm32f405);
    unlock(&mut rig);
    rig.write(RCC_BDCR, 1);
    assert!(matches!(rig.problems()[..], [Problem::Misuse(_)]));
    assert_eq!(rig.at(Time::from_s(10)).read(RCC_BDCR), 1, "LSERDY stays 0");
}
