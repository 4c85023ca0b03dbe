//! `lss find` leaves each board where it was.

use std::{cell::Cell, rc::Rc};

use canopen_node::BitRate;
use emulator::{Time, network::Source};
use testkit::image::Firmware;

use crate::emulated::Boards;

/// No node-ID.
const NONE: u8 = 0xFF;

/// Runs `lss find --ask`, and asserts that it finds the bit rates of these boards, and that all of them are there, in
/// LSS waiting state and with their settings.
#[track_caller]
fn assert_harmless(firmware: Firmware, list: &[(u8, BitRate)]) {
    let boards = Boards::unattended(firmware, list, 0);
    let found = boards.lss("find --ask").text;
    for (board, (id, home)) in list.iter().enumerate() {
        let rates = boards.rig().bit_rates(board, Time::ZERO);
        let (_, rate) = *rates.last().expect("it has a bit rate");
        assert_eq!(rate, u32::from(home.kbit_per_s()) * 1000, "{list:?}, board {board}");
        assert!(found.contains(&format!("the network runs at {home}")));
        // One at another bit rate would spoil the question.
        let others = (0..list.len()).filter(|other| list[*other].1 != *home).map(Source::Board);
        others.for_each(|other| boards.rig().network.cut_wire(other));
        boards.assert_waiting(*home);
        (0..list.len()).for_each(|board| boards.rig().network.mend_wire(Source::Board(board)));
        assert_eq!(boards.stored(board), Some((*id, home.index())));
    }
}

#[test]
fn blank_boards_stay_at_their_bit_rate_and_it_is_found() {
    for home in BitRate::ALL {
        assert_harmless(Firmware::Default, &[(NONE, home)]);
        assert_harmless(Firmware::Default, &[(NONE, home), (NONE, home)]);
    }
}

#[test]
fn nodes_and_plain_slaves_stay_at_their_bit_rate_and_it_is_found() {
    for home in BitRate::ALL {
        assert_harmless(Firmware::Default, &[(5, home), (NONE, home)]);
        assert_harmless(Firmware::Plain, &[(NONE, home), (6, home)]);
    }
}

#[test]
fn boards_at_two_bit_rates_are_both_found_and_stay() {
    use BitRate::{Kbit10, Kbit20, Kbit50, Kbit125, Kbit250, Kbit500, Kbit1000};
    for (one, other) in [
        (Kbit125, Kbit1000),
        (Kbit50, Kbit125),
        (Kbit500, Kbit250),
        (Kbit1000, Kbit10),
        (Kbit10, Kbit20),
    ] {
        assert_harmless(Firmware::Default, &[(NONE, one), (NONE, other)]);
    }
}

#[test]
fn a_silent_network_is_not_disturbed_unless_the_user_says_so() {
    let list = [(5, BitRate::Kbit500), (6, BitRate::Kbit500)];
    let boards = Boards::unattended(Firmware::Default, &list, 30_000);
    let requests = Rc::new(Cell::new(0));
    let counted = Rc::clone(&requests);
    boards.at_each_frame(move |_, _| counted.set(counted.get() + 1));
    let errors = boards.rig().errors().len();
    let outcome = boards.lss("find");
    assert_eq!((outcome.code, requests.get()), (3, 0), "{}", outcome.text);
    assert!(outcome.error.contains("`lss find --ask` asks at each of them"), "{}", outcome.error);
    assert_eq!(boards.rig().errors().len(), errors);
}

#[test]
fn nodes_that_send_at_two_bit_rates_are_both_heard_and_told() {
    use BitRate::{Kbit125, Kbit250};
    let list = [(5, Kbit125), (6, Kbit125), (7, Kbit250), (8, Kbit250)];
    let boards = Boards::unattended(Firmware::Default, &list, 300);
    // Two that have heard each other stay at their bit rate.
    for others in [[2, 3], [0, 1]].map(|others| others.map(Source::Board)) {
        let network = &mut boards.rig().network;
        others.iter().for_each(|other| network.cut_wire(*other));
        network.run_for(Time::from_ms(10_000));
        others.iter().for_each(|other| network.mend_wire(*other));
    }
    let outcome = boards.lss("find");
    assert_eq!(outcome.code, 1, "{}", outcome.text);
    assert!(outcome.error.starts_with("boards at different bit rates disturb each other"));
    for rate in ["125", "250"] {
        assert!(outcome.text.contains(&format!("boards run at {rate} kbit/s\nheard: ")));
    }
}

#[test]
fn new_boards_are_silent_and_the_user_is_told_of_the_list() {
    let outcome = Boards::new(BitRate::Kbit125, &[NONE, NONE]).lss("find");
    assert_eq!(outcome.code, 3);
    let words =
        "no frame at any bit rate. New boards are silent, at 125 kbit/s: `lss list` shows them";
    assert!(outcome.error.starts_with(words), "{}", outcome.error);
}
