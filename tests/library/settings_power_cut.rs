//! The settings log with power cuts in any program or erase step, also two in a row: nothing acknowledged is lost, and
//! settings found once stay, although an interrupted word reads differently at each power-on.

use canopen_node::settings::Log;
use testkit::{
    flash::Flash,
    power_cut::{Expected, cut_at_random, cut_twice},
    random::Random,
    settings::settings,
};

/// No room for parameters.
const LEN: usize = 0;

#[test]
fn two_cuts_in_any_steps_lose_nothing_written_in_words() {
    cut_twice::<LEN, 4, 128>(&[0xFF; 256], 10, 1);
}

#[test]
fn two_cuts_in_any_steps_lose_nothing_written_in_bytes() {
    cut_twice::<LEN, 1, 128>(&[0xFF; 256], 7, 29);
}

#[test]
fn two_cuts_in_any_steps_lose_nothing_in_the_smallest_banks() {
    cut_twice::<LEN, 4, 96>(&[0xFF; 192], 9, 1);
}

#[test]
fn two_cuts_in_any_steps_lose_nothing_where_garbage_is_formatted_first() {
    cut_twice::<LEN, 4, 128>(&[0xA5; 256], 4, 3);
    cut_twice::<LEN, 2, 256>(&[0x00; 512], 2, 11);
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
    cut_at_random::<LEN>(500, 100, 20);
}

#[test]
fn cuts_in_banks_of_16_kb_that_are_nearly_full_lose_nothing() {
    const STORES: usize = 12;
    let mut random = Random::from_environment();
    let flash = Flash::<4, 0x4000>::blank(0);
    let mut expected = Expected::<LEN>::nothing();
    // A power-on before every third store, and after the last: four places each; 510 follow the mark and the first
    // record. The log moves to the other bank, and the next power-on erases this one.
    expected.live(&flash, 3 * 126);
    for cut in 0..expected.steps(&flash, STORES) {
        let flash = flash.duplicate(random.u64());
        let mut expected = expected.clone();
        flash.cut_power_after(cut);
        expected.live(&flash, STORES);
        flash.power_on();
        flash.cut_power_after(random.within(0..20) as usize);
        expected.live(&flash, STORES);
        flash.power_on();
        expected.live(&flash, STORES);
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
