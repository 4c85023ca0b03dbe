//! The settings log with power cuts in any program or erase step, also two in a row: nothing acknowledged is lost,
//! settings and parameters are found together, and what was found once stays, although an interrupted word reads
//! differently at each power-on.

use testkit::{
    flash::Flash,
    power_cut::{Expected, cut_at_random, cut_twice, cut_while_moving, store},
    random::Random,
    settings::{open_with_parameters, parameters, settings},
};

/// No room for parameters.
const LEN: usize = 0;
/// The longest parameters, which take two places of 32 bytes.
const WITH_PARAMETERS: usize = 40;

#[test]
fn two_cuts_in_any_steps_lose_nothing() {
    cut_twice::<LEN, 4, 128>(&[0xFF; 256], 10, 1);
    // Written in bytes.
    cut_twice::<LEN, 1, 128>(&[0xFF; 256], 7, 29);
    // In the smallest banks.
    cut_twice::<LEN, 4, 96>(&[0xFF; 192], 9, 1);
    // Garbage is formatted first.
    cut_twice::<LEN, 4, 128>(&[0xA5; 256], 4, 3);
    cut_twice::<LEN, 2, 256>(&[0x00; 512], 2, 11);
}

#[test]
fn cuts_in_the_commit_words_of_a_store_and_of_the_starts_after_it_lose_nothing() {
    let mut random = Random::from_environment();
    // Two stores fill the bank of four places, and three the other one.
    for stores in 1..6 {
        let life = Flash::<4, 128>::blank(0);
        Expected::<LEN>::nothing().power_on(&life, stores);
        let steps = life.writes() + life.erases();
        for _ in 0..500 {
            let flash = Flash::<4, 128>::blank(random.u64());
            let mut expected = Expected::<LEN>::nothing();
            // The last words of a record are its CRC and its last word.
            flash.cut_power_after(steps - random.pick(&[1, 2]));
            expected.power_on(&flash, stores);
            for _ in 0..random.within(1..3) {
                flash.power_on();
                flash.cut_power_after(random.pick(&[6, 7]));
                expected.power_on(&flash, 0);
            }
            for _ in 0..4 {
                flash.power_on();
                expected.power_on(&flash, 0);
            }
        }
    }
}

#[test]
fn as_many_cut_starts_in_a_row_as_a_bank_has_places_for_copies_lose_nothing() {
    // The others hold the mark and the record that is copied.
    const MOST_CUT_STARTS: u32 = 4 - 2;
    let mut random = Random::from_environment();
    for _ in 0..2_000 {
        let flash = Flash::<4, 128>::blank(random.u64());
        let mut expected = Expected::<LEN>::nothing();
        let mut cut_starts = 0;
        for _ in 0..40 {
            let stores = if random.one_in(3) { random.within(0..4) } else { 0 };
            // In the last words of a copy or of a store, in a mark or an erase, in any word.
            let any = random.within(0..30);
            let step = random.pick(&[6, 7, 6, 7, (8 * stores).saturating_sub(1), 0, any]);
            if cut_starts < MOST_CUT_STARTS {
                flash.cut_power_after(step as usize);
            }
            let is_complete = expected.power_on(&flash, stores as usize);
            cut_starts = if is_complete { 0 } else { cut_starts + 1 };
            flash.power_on();
        }
    }
}

#[test]
fn random_histories_with_any_number_of_cuts_lose_nothing() {
    cut_at_random::<LEN, 4, 256>(1, 500, 100, 20);
}

#[test]
fn cuts_in_banks_of_16_kb_that_are_nearly_full_lose_nothing() {
    cut_while_moving::<LEN, 4, 0x4000>(1, &mut Random::from_environment());
}

#[test]
fn two_cuts_in_any_steps_lose_no_parameters() {
    cut_twice::<WITH_PARAMETERS, 4, 512>(&[0xFF; 1024], 14, 7);
    // Written in bytes.
    cut_twice::<WITH_PARAMETERS, 1, 256>(&[0xFF; 512], 6, 61);
    // In the smallest banks.
    cut_twice::<WITH_PARAMETERS, 4, 192>(&[0xFF; 384], 8, 3);
}

#[test]
fn random_histories_of_parameters_with_any_number_of_cuts_lose_nothing() {
    cut_at_random::<WITH_PARAMETERS, 4, 256>(1, 400, 150, 16);
}

/// Cuts the power in each step of a store of a record, behind parameters of these lengths if there is room for them.
fn cut_in_each_step<const LEN: usize>(old_len: usize, new_len: usize, steps: usize) {
    let mut random = Random::from_environment();
    let old = (Some(settings(1)), parameters(1, old_len));
    let new = (Some(settings(2)), parameters(2, new_len));
    for cut in 0..=steps {
        let mut found_new = 0;
        for _ in 0..100 {
            let flash = Flash::<4, 512>::blank(random.u64());
            let (mut log, ..) = open_with_parameters::<LEN, 4, 512>(&flash);
            assert!(store(&mut log, &old));
            flash.cut_power_after(cut);
            assert_eq!(store(&mut log, &new), cut == steps);
            flash.power_on();
            let first = open_with_parameters::<LEN, 4, 512>(&flash).1;
            assert!(first == old || first == new, "step {cut}: {first:?}");
            found_new += usize::from(first == new);
            for _ in 0..5 {
                flash.cycle_power();
                assert_eq!(open_with_parameters::<LEN, 4, 512>(&flash).1, first, "step {cut}");
            }
        }
        // The CRC is the last word but one; if it is cut, it may read as written.
        let expected = if cut + 2 < steps {
            0..1
        } else if cut + 1 < steps {
            10..90
        } else {
            100..101
        };
        assert!(expected.contains(&found_new), "step {cut}: new in {found_new} of 100 cases");
    }
}

#[test]
fn a_cut_store_leaves_both_old_or_both_new_at_every_power_on() {
    cut_in_each_step::<LEN>(0, 0, 8);
    cut_in_each_step::<WITH_PARAMETERS>(30, 34, 24);
}
