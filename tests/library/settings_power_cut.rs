//! The settings log with power cuts in any program or erase step, also two in a row: nothing acknowledged is lost, and
//! settings found once stay, although an interrupted word reads differently at each power-on.

use lss_slave::{Settings, settings::Log};
use testkit::{flash::Flash, random::Random, settings::settings};

/// The settings that may be found at the next power-on.
#[derive(Clone)]
struct Expected {
    /// The settings last stored or found; `None`: the defaults.
    known: Option<Settings>,
    /// The settings of later stores that the power cuts interrupted.
    attempted: Vec<Settings>,
    /// The next settings to store.
    next: u16,
}

impl Expected {
    /// The expectation for a new device, or one full of garbage.
    fn nothing() -> Self {
        Self { known: None, attempted: Vec::new(), next: 1 }
    }
}

/// The life of a device until its power fails: it is powered on, stores, and is powered on again, until it has made a
/// number of stores.
fn live<const W: usize, const E: usize>(
    flash: &Flash<W, E>,
    expected: &mut Expected,
    stores: usize,
) {
    const STORES_A_POWER_ON: usize = 3;
    let mut made = 0;
    loop {
        flash.cycle_power();
        let (mut log, found) = Log::open(flash.clone());
        if !flash.is_powered() {
            return;
        }
        let read = log.settings();
        let is_attempted = expected.attempted.iter().any(|&settings| read == Some(settings));
        assert!(
            read == expected.known || is_attempted,
            "{found:?} {read:?}, but {:?} is known and {:?} were attempted",
            expected.known,
            expected.attempted
        );
        expected.known = read;
        expected.attempted.clear();
        if made >= stores {
            return;
        }
        for _ in 0..STORES_A_POWER_ON {
            let new = settings(expected.next);
            expected.next += 1;
            made += 1;
            let erases = flash.erases();
            let outcome = log.store(new);
            assert_eq!(flash.erases(), erases, "only open erases");
            if outcome.is_ok() {
                expected.known = Some(new);
                expected.attempted.clear();
            } else if !flash.is_powered() {
                expected.attempted.push(new);
            }
            if !flash.is_powered() {
                return;
            }
        }
    }
}

/// Program and erase steps of a life without a power cut.
fn steps<const W: usize, const E: usize>(
    flash: &Flash<W, E>,
    expected: &Expected,
    stores: usize,
) -> usize {
    let flash = flash.duplicate(0);
    live(&flash, &mut expected.clone(), stores);
    flash.writes() + flash.erases()
}

/// Cuts the power in each step of a life, and then in each step of the next life, or in one of `every` steps; a third
/// life checks.
fn cut_twice<const W: usize, const E: usize>(content: &[u8], stores: usize, every: usize) {
    let mut random = Random::from_environment();
    let new = Flash::<W, E>::with_content(content.to_vec(), 0);
    for first in 0..steps(&new, &Expected::nothing(), stores) {
        let flash = new.duplicate(random.u64());
        let mut expected = Expected::nothing();
        flash.cut_power_after(first);
        live(&flash, &mut expected, stores);
        assert!(!flash.is_powered(), "step {first}");
        let from = random.within(0..every as u64) as usize;
        for second in (from..steps(&flash, &expected, 4)).step_by(every) {
            let flash = flash.duplicate(random.u64());
            let mut expected = expected.clone();
            flash.cut_power_after(second);
            live(&flash, &mut expected, 4);
            flash.power_on();
            live(&flash, &mut expected, 4);
        }
    }
}

#[test]
fn two_cuts_in_any_steps_lose_nothing_written_in_words() {
    cut_twice::<4, 128>(&[0xFF; 256], 10, 1);
}

#[test]
fn two_cuts_in_any_steps_lose_nothing_written_in_bytes() {
    cut_twice::<1, 128>(&[0xFF; 256], 7, 29);
}

#[test]
fn two_cuts_in_any_steps_lose_nothing_in_the_smallest_banks() {
    cut_twice::<4, 64>(&[0xFF; 128], 9, 1);
}

#[test]
fn two_cuts_in_any_steps_lose_nothing_where_garbage_is_formatted_first() {
    cut_twice::<4, 128>(&[0xA5; 256], 4, 3);
    cut_twice::<2, 256>(&[0x00; 512], 2, 11);
}

#[test]
fn settings_found_after_a_cut_are_found_at_every_power_on() {
    let mut random = Random::from_environment();
    let mut found_new = 0;
    for cut in 0..8 {
        for _ in 0..200 {
            let flash = Flash::<4, 256>::blank(random.u64());
            let (mut log, _) = Log::open(flash.clone());
            log.store(settings(1)).unwrap();
            flash.cut_power_after(cut);
            assert!(log.store(settings(2)).is_err());
            flash.power_on();
            let first = Log::open(flash.clone()).0.settings();
            found_new += u32::from(first == Some(settings(2)));
            for _ in 0..5 {
                flash.cycle_power();
                assert_eq!(Log::open(flash.clone()).0.settings(), first, "step {cut}");
            }
        }
    }
    assert!((20..180).contains(&found_new), "{found_new} of 200 cut commit words read valid");
}

#[test]
fn random_histories_with_any_number_of_cuts_lose_nothing() {
    let mut random = Random::from_environment();
    for _ in 0..500 {
        let flash = Flash::<4, 256>::blank(random.u64());
        let mut expected = Expected::nothing();
        for _ in 0..20 {
            flash.cut_power_after(random.within(0..100) as usize);
            live(&flash, &mut expected, random.within(0..20) as usize);
            flash.power_on();
        }
        live(&flash, &mut expected, 4);
    }
}

#[test]
fn cuts_in_banks_of_16_kb_that_are_nearly_full_lose_nothing() {
    const STORES: usize = 12;
    let mut random = Random::from_environment();
    let flash = Flash::<4, 0x4000>::blank(0);
    let mut expected = Expected::nothing();
    // Power-ons at 378, 381 and 384 stores: the last of them moves to the other bank.
    live(&flash, &mut expected, 378);
    for cut in 0..steps(&flash, &expected, STORES) {
        let flash = flash.duplicate(random.u64());
        let mut expected = expected.clone();
        flash.cut_power_after(cut);
        live(&flash, &mut expected, STORES);
        flash.power_on();
        flash.cut_power_after(random.within(0..20) as usize);
        live(&flash, &mut expected, STORES);
        flash.power_on();
        live(&flash, &mut expected, STORES);
        assert_ne!(flash.erases(), 0, "it has moved");
    }
}

#[test]
fn a_cut_in_a_store_leaves_old_or_new_settings_and_at_the_end_the_new() {
    let mut random = Random::from_environment();
    for cut in 0..=8 {
        for _ in 0..100 {
            let flash = Flash::<4, 128>::blank(random.u64());
            let (mut log, _) = Log::open(flash.clone());
            log.store(settings(1)).unwrap();
            flash.cut_power_after(cut);
            let outcome = log.store(settings(2));
            flash.power_on();
            let read = Log::open(flash.clone()).0.settings();
            assert_eq!(outcome.is_ok(), cut == 8);
            match cut {
                // Without the commit word, the last of eight, there are no new settings.
                0..7 => assert_eq!(read, Some(settings(1)), "step {cut}"),
                7 => assert!(read == Some(settings(1)) || read == Some(settings(2))),
                _ => assert_eq!(read, Some(settings(2))),
            }
        }
    }
}
