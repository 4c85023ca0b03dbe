//! Parameters in the settings log with power cuts in any program or erase step, also two in a row: settings and
//! parameters of an acknowledged store are found together, and what was found once stays.

use testkit::{
    flash::Flash,
    power_cut::{cut_at_random, cut_twice, store},
    random::Random,
    settings::{open_with_parameters, parameters, settings},
};

/// The longest parameters, which take two places of 32 bytes.
const LEN: usize = 40;

#[test]
fn two_cuts_in_any_steps_lose_no_parameters_in_the_smallest_banks() {
    cut_twice::<LEN, 4, 192>(&[0xFF; 384], 8, 3);
}

#[test]
fn two_cuts_in_any_steps_lose_no_parameters_written_in_words() {
    cut_twice::<LEN, 4, 512>(&[0xFF; 1024], 14, 7);
}

#[test]
fn two_cuts_in_any_steps_lose_no_parameters_written_in_bytes() {
    cut_twice::<LEN, 1, 256>(&[0xFF; 512], 6, 61);
}

#[test]
fn random_histories_of_parameters_with_any_number_of_cuts_lose_nothing() {
    cut_at_random::<LEN>(400, 150, 16);
}

#[test]
fn a_cut_store_leaves_both_old_or_both_new_at_every_power_on() {
    let mut random = Random::from_environment();
    let (old, new) =
        ((Some(settings(1)), parameters(1, 30)), (Some(settings(2)), parameters(2, 34)));
    // Parameters of two places, and the record: 24 words.
    for cut in 0..=24 {
        let mut found_new = 0;
        for _ in 0..50 {
            let flash = Flash::<4, 512>::blank(random.u64());
            let (mut log, ..) = open_with_parameters::<LEN, 4, 512>(&flash);
            assert!(store(&mut log, &old));
            flash.cut_power_after(cut);
            assert_eq!(store(&mut log, &new), cut == 24);
            flash.power_on();
            let first = open_with_parameters::<LEN, 4, 512>(&flash).1;
            assert!(first == old || first == new, "step {cut}: {first:?}");
            found_new += u32::from(first == new);
            for _ in 0..5 {
                flash.cycle_power();
                assert_eq!(open_with_parameters::<LEN, 4, 512>(&flash).1, first, "step {cut}");
            }
        }
        match cut {
            0..23 => assert_eq!(found_new, 0, "there is no commit word"),
            23 => assert!((1..50).contains(&found_new), "it may read as written"),
            _ => assert_eq!(found_new, 50),
        }
    }
}
