//! Bit-rate supervision during a search: the duration of looks, their order, and the turns at home.

use lss_slave::{
    BitRate, BitRates,
    BusEvent::{Acknowledged, BusOff, Error, FormError, HeldDominant, Received},
    Frame,
};
use testkit::{
    flash::BoardFlash,
    frames::SILENCE,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    supervised::{TURN_US, doubt, looking, powered_on, proven, unproven},
};

#[test]
fn a_look_that_hears_nothing_ends_in_a_silent_and_an_open_turn_of_home() {
    let mut board = looking();
    board.pass_ms(60_000);
    let expected = ["40 ms listen at 125 kbit/s", "62.16 ms 125 kbit/s", "62.16 ms resume"];
    assert_eq!(board.timeline(), expected);
    doubt(&mut board);
}

#[test]
fn the_silent_turn_of_home_lasts_20_ms_and_the_time_of_two_frames() {
    for (home, ms) in [(BitRate::Kbit1000, "60.27"), (BitRate::Kbit10, "87")] {
        let mut board = powered_on(home, 0);
        doubt(&mut board);
        board.timeline();
        board.pass_ms(200);
        assert_eq!(board.timeline()[1], format!("{ms} ms {} kbit/s", home.kbit_per_s()));
    }
}

#[test]
fn the_open_turn_of_home_lasts_150_ms_or_3000_bits() {
    for (home, ms) in [(BitRate::Kbit1000, 150), (BitRate::Kbit20, 150), (BitRate::Kbit10, 300)] {
        let mut board = powered_on(home, 0);
        doubt(&mut board);
        board.see(FormError);
        while board.node.is_listening() {
            board.pass_ms(1);
        }
        board.pass_ms(ms - 1);
        assert!(!board.node.is_listening(), "{home:?}");
        board.pass_ms(1);
        assert!(board.node.is_listening(), "{home:?}");
    }
}

#[test]
fn a_look_ends_40_ms_after_the_first_event() {
    // The first look ends by itself after 40 ms; those after something was heard wait 1.1 s.
    for (heard_at_ms, end_ms) in [(1, 41), (500, 540), (1_080, 1_100)] {
        let mut board = looking();
        board.see(FormError);
        board.pass_us(40_000 + TURN_US + 150_000);
        assert!(board.node.is_listening(), "something was heard: the next look");
        board.timeline();
        board.pass_ms(heard_at_ms);
        board.see(FormError);
        board.see(FormError);
        board.pass_ms(40);
        assert_eq!(board.timeline(), [format!("{end_ms} ms listen at 125 kbit/s")]);
    }
}

#[test]
fn a_second_look_that_hears_nothing_ends_the_search() {
    let mut board = looking();
    board.see(FormError);
    board.pass_us(40_000 + TURN_US + 150_000);
    board.timeline();
    board.pass_ms(60_000);
    let expected = ["1100 ms listen at 125 kbit/s", "1122.16 ms 125 kbit/s", "1122.16 ms resume"];
    assert_eq!(board.timeline(), expected);
}

#[test]
fn while_errors_go_on_home_is_never_away_for_100_ms() {
    for (error, us) in [(Error, 300), (Error, 20_000), (FormError, 300), (FormError, 20_000)] {
        let mut board = looking();
        let mut away_us = 0;
        for _ in 0..20_000_000 / us {
            board.see(error);
            board.pass_us(us);
            let is_away = board.bit_rate() != BitRate::Kbit125;
            away_us = if is_away { away_us + us } else { 0 };
            assert!(away_us < 100_000, "{error:?} every {us} us");
        }
        assert!(board.timeline().len() > 200, "it continues to look");
    }
}

#[test]
fn an_error_elsewhere_leads_to_the_next_slower_rate_and_never_to_home() {
    let mut board = looking();
    for kbit_per_s in [800, 500, 250, 50, 20, 10, 1000, 800] {
        board.see(Error);
        assert_eq!(board.timeline(), [format!("0 ms listen at {kbit_per_s} kbit/s")]);
    }
}

#[test]
fn a_rate_that_the_clock_cannot_make_is_not_listened_to() {
    let bit_rates = BitRates::possible(42_000_000);
    assert!(!bit_rates.contains(BitRate::Kbit800));
    let device = device(ADDRESS).with_bit_rates(bit_rates).with_rescue(true);
    let settings = defaults(0x40).with_bit_rate(BitRate::Kbit125.into());
    let mut board = NodeRig::with_device(device.with_defaults(settings), BoardFlash::blank(0), 0);
    doubt(&mut board);
    board.see(Error);
    assert_eq!(board.bit_rate(), BitRate::Kbit500);
}

#[test]
fn form_errors_elsewhere_keep_the_rate_for_one_look() {
    let mut board = looking();
    for _ in 0..100 {
        board.see(FormError);
    }
    assert_eq!(board.timeline(), SILENCE);
    board.pass_ms(40);
    board.see(Error);
    board.pass_us(TURN_US);
    let expected = ["40 ms listen at 125 kbit/s", "62.16 ms listen at 800 kbit/s"];
    assert_eq!(board.timeline(), expected, "errors at home too: the next rate");
}

#[test]
fn a_look_that_has_moved_goes_on_where_it_ended() {
    let mut board = looking();
    board.see(Error);
    board.see(Error);
    board.pass_ms(40);
    board.see(Error);
    board.timeline();
    board.pass_us(TURN_US);
    assert_eq!(board.timeline(), ["22.16 ms listen at 500 kbit/s"]);
}

#[test]
fn a_look_that_has_not_moved_ends_the_stay_at_its_rate() {
    let mut board = looking();
    board.see(Error);
    board.pass_ms(40);
    board.see(Error);
    board.pass_us(TURN_US);
    assert_eq!(board.bit_rate(), BitRate::Kbit800);
    board.see(FormError);
    board.pass_ms(40);
    board.see(Error);
    board.pass_us(TURN_US);
    assert_eq!(board.bit_rate(), BitRate::Kbit500, "only form errors at 800 kbit/s");
}

#[test]
fn after_errors_in_the_silent_turn_of_home_the_next_look_lasts_40_ms() {
    let mut board = looking();
    board.pass_ms(40);
    board.see(Error);
    board.pass_us(TURN_US);
    board.timeline();
    board.pass_ms(41);
    assert_eq!(board.timeline(), ["40 ms listen at 125 kbit/s"]);
}

#[test]
fn a_form_error_in_the_silent_turn_of_home_opens_home() {
    let mut board = looking();
    board.pass_ms(41);
    board.timeline();
    board.see(FormError);
    assert_eq!(board.timeline(), ["0 ms 125 kbit/s", "0 ms resume"]);
    assert_eq!(board.lss("04 01"), SILENCE);
    assert_eq!(board.lss("5E"), ["5E 40"], "a lone master is answered");
    board.pass_ms(1_000);
    assert_eq!(board.timeline(), ["0 ms 7E4: 5E 40 00 00 00 00 00 00"], "and the search is over");
}

#[test]
fn a_valid_frame_or_an_acknowledge_at_home_ends_the_search() {
    let in_silent_turn = 40_000;
    let in_open_turn = 40_000 + TURN_US;
    for (us, proof) in
        [(in_silent_turn, Received), (in_open_turn, Received), (in_open_turn, Acknowledged)]
    {
        let mut board = looking();
        board.see(FormError);
        board.pass_us(us);
        board.see(proof);
        assert!(!board.node.is_listening());
        board.timeline();
        board.see(Error);
        board.pass_ms(2_000);
        board.see(Error);
        board.pass_ms(2_000);
        assert_eq!(board.timeline(), SILENCE, "after {us} us {proof:?}");
    }
}

#[test]
fn an_error_ends_the_open_turn_of_home_after_20_ms_and_two_frames() {
    for error in [Error, FormError] {
        let mut board = looking();
        board.pass_us(40_000 + TURN_US);
        board.timeline();
        board.see(error);
        assert_eq!(board.timeline(), ["0 ms stop", "0 ms resume"], "waiting frames are dropped");
        board.pass_us(TURN_US);
        assert_eq!(board.timeline(), ["22.16 ms listen at 1000 kbit/s"]);
        board.pass_ms(1_099);
        assert_eq!(board.timeline(), SILENCE, "it waits for something to be heard");
        board.pass_ms(1);
        assert_eq!(board.timeline(), ["1 ms listen at 125 kbit/s"], "{error:?}");
    }
}

#[test]
fn a_master_between_errors_in_the_open_turn_of_home_is_answered() {
    let mut board = looking();
    board.pass_us(40_000 + TURN_US);
    board.see(Error);
    board.timeline();
    board.pass_ms(20);
    board.lss("04 01");
    assert_eq!(board.lss("5E"), ["5E 40"]);
    board.pass_ms(5_000);
    assert_eq!(board.bit_rate(), BitRate::Kbit125, "the search is over");
}

#[test]
fn a_turn_that_a_form_error_opened_begins_with_50_ms_of_silence() {
    let mut board = unproven();
    board.see(Error);
    board.pass_ms(41);
    board.timeline();
    board.see(FormError);
    assert_eq!(board.timeline(), ["0 ms 125 kbit/s", "0 ms resume"]);
    board.pass_ms(60);
    assert_eq!(board.timeline(), ["50 ms 740: 00"], "a lone master needs the bus");
}

#[test]
fn a_form_error_after_another_error_does_not_open_home() {
    let mut board = looking();
    board.pass_ms(41);
    board.see(Error);
    board.see(FormError);
    assert!(board.node.is_listening(), "a node sends at another rate");
}

#[test]
fn a_bus_that_is_held_dominant_ends_the_search_at_once() {
    for us in [1, 40_000, 40_000 + TURN_US] {
        let mut board = unproven();
        board.see(Error);
        board.pass_us(us);
        let was_listening = board.node.is_listening();
        board.timeline();
        board.see(HeldDominant);
        let acts = board.timeline();
        assert_eq!(acts.first().map(String::as_str), was_listening.then_some("0 ms 125 kbit/s"));
        board.pass_ms(10_000);
        assert_eq!(board.bit_rate(), BitRate::Kbit125);
        assert!(!board.timeline().iter().any(|act| act.contains("listen")), "{us} us");
    }
}

#[test]
fn errors_before_the_bus_was_held_dominant_do_not_count() {
    let mut board = proven();
    board.see(Error);
    board.pass_ms(900);
    board.see(Error);
    board.see(HeldDominant);
    board.pass_ms(900);
    board.see(Error);
    assert!(!board.node.is_listening());
}

#[test]
fn a_boot_up_elsewhere_does_not_make_a_guest_but_a_heartbeat_does() {
    for (state, is_guest) in [(0x00, false), (0x05, true), (0x7F, true)] {
        let mut board = looking();
        let frame = Frame::new(0x701, &[state]).expect("one byte");
        board.receive(&frame);
        assert_eq!(!board.node.is_listening(), is_guest, "{state:02X}");
    }
}

#[test]
fn a_boot_up_at_home_ends_the_search() {
    let mut board = looking();
    board.pass_ms(41);
    board.receive(&Frame::new(0x701, &[0]).expect("one byte"));
    assert!(!board.node.is_listening());
}

/// Whether a look that hears nothing is followed by another one after the turns at home.
fn looks_twice(board: &mut NodeRig) -> bool {
    board.timeline();
    board.pass_us(40_000 + TURN_US + 150_000);
    board.node.is_listening()
}

#[test]
fn a_node_that_found_itself_alone_does_not_wait_after_one_error() {
    for (ms, waits) in [(99, true), (100, false)] {
        let mut board = unproven();
        board.pass_ms(ms);
        board.see(Error);
        assert_eq!(looks_twice(&mut board), waits, "alone for {ms} ms");
    }
}

#[test]
fn after_a_disturbance_of_30_ms_no_look_waits() {
    for (ms, waits) in [(29, true), (30, false)] {
        let mut board = unproven();
        for _ in 0..ms {
            board.see(FormError);
            board.pass_ms(1);
        }
        board.see(FormError);
        board.pass_us(40_000 + TURN_US + 150_000);
        assert!(board.node.is_listening());
        board.pass_ms(60);
        assert_eq!(board.bit_rate() != BitRate::Kbit125, waits, "{ms} ms");
    }
}

#[test]
fn errors_in_the_open_turn_of_home_are_no_part_of_a_disturbance() {
    let mut board = unproven();
    board.see(Error);
    for _ in 0..3 {
        board.see(FormError);
        board.pass_ms(5);
    }
    board.pass_us(25_000 + TURN_US);
    assert!(!board.node.is_listening());
    // Its own frame has disturbed the others.
    board.see(Error);
    board.pass_us(TURN_US);
    assert!(board.node.is_listening());
    board.pass_ms(1_000);
    assert_ne!(board.bit_rate(), BitRate::Kbit125, "it waits for the next rare frame");
}

#[test]
fn bus_off_is_recovered_from_also_while_the_node_looks() {
    let mut board = unproven();
    board.see(Error);
    board.see(BusOff);
    board.pass_ms(16);
    board.see(HeldDominant);
    assert_eq!(board.bit_rate(), BitRate::Kbit125);
    board.timeline();
    board.pass_ms(33);
    assert_eq!(board.timeline(), SILENCE, "the controller recovers");
    board.pass_ms(1);
    assert_eq!(board.timeline(), ["1 ms 740: 00"]);
}

#[test]
fn for_3_s_after_a_fruitless_search_a_second_look_follows_the_first() {
    for (us_later, is_doubted) in [(1_999_999, true), (2_000_000, false)] {
        let mut board = looking();
        assert!(!looks_twice(&mut board));
        board.pass_us(us_later);
        doubt(&mut board);
        assert_eq!(looks_twice(&mut board), is_doubted);
    }
}

#[test]
fn at_an_unproven_home_rate_a_second_look_follows_the_first() {
    let mut board = unproven();
    board.see(Error);
    assert!(looks_twice(&mut board), "frames may be rare");
    board.timeline();
    board.pass_ms(2_000);
    assert_eq!(board.timeline()[0], "1100 ms listen at 125 kbit/s", "and waits for one");
    assert!(!board.node.is_listening(), "there is no third");
}

#[test]
fn an_unacknowledged_boot_up_is_repeated_in_an_open_turn_at_home() {
    let mut board = unproven();
    board.see(Error);
    board.timeline();
    board.pass_ms(70);
    assert_eq!(board.timeline()[2..], ["62.16 ms resume", "62.16 ms 740: 00"]);
    board.see(Acknowledged);
    board.pass_ms(30_000);
    doubt(&mut board);
    assert_eq!(board.pass_ms(1_000), SILENCE, "after an acknowledge it does not");
}

#[test]
fn after_half_a_second_of_errors_home_is_open_in_spite_of_them() {
    let mut board = unproven();
    let mut open_ms = 0;
    for _ in 0..1_000 {
        board.see(Error);
        open_ms += u32::from(!board.node.is_listening());
        board.pass_ms(1);
    }
    assert!((150..=300).contains(&open_ms), "open for {open_ms} ms of a second");
    assert!(board.timeline().iter().any(|act| act.contains("740: 00")), "it boots up");
}
