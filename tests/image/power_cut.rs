//! The release image with power cuts in any flash operation of its start and of two commissionings: reachable
//! afterwards, with the old or the new settings, although an interrupted word reads differently at each power-on.
//! `cargo verify power-cut` cuts the power of the library, in longer histories.

use testkit::{boards::Variant, power_cut::image::Session};

use crate::rig::*;

fn assert_nothing_is_lost(session: Session) {
    let mut random = Random::from_environment();
    let chip_variant = ChipVariant { cut_words_flip: true, ..ChipVariant::default() };
    let settings = board::Settings { chip_variant, ..board::Settings::default() };
    let variant = Variant { image: image(), part: PART, settings };
    let outcome = session.run(&variant, &mut random);
    let cuts = outcome.unwrap_or_else(|error| panic!("{error:#}"));
    // Two records of eight words are the least.
    assert!(cuts >= 16, "{cuts} cuts");
}

#[test]
fn cuts_in_formatting_and_two_stores_leave_the_defaults_the_old_or_the_new_settings() {
    assert_nothing_is_lost(Session::Blank);
}

#[test]
fn cuts_in_stores_that_move_to_the_other_sector_leave_the_old_or_the_new_settings() {
    assert_nothing_is_lost(Session::Full);
}

#[test]
fn cuts_in_a_start_that_erases_and_two_stores_leave_the_old_or_the_new_settings() {
    assert_nothing_is_lost(Session::Moved);
}
