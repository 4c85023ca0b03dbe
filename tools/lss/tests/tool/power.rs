//! `lss assign --power-check`.

use canopen_node::BitRate;
use emulator::network::{Network, Source};
use testkit::image_rig::{SETTINGS_LENGTH, SETTINGS_OFFSET, flash_with, settings};

use crate::emulated::{Boards, Outcome};

const RATE: BitRate = BitRate::Kbit125;

/// Runs `lss assign --power-check` on two new boards. The power of these boards is away from the 20th to the 25th
/// second.
fn check(boards: &Boards, without_power: &'static [usize]) -> Outcome {
    boards.after(20, move |network| {
        without_power.iter().for_each(|board| network.power_off(*board));
    });
    boards.after(25, move |network| {
        without_power.iter().for_each(|board| network.power_on(*board));
    });
    let outcome = boards.lss("assign --power-check");
    assert_eq!(outcome.text.matches("stored, verified by a reset\n").count(), 2);
    assert!(outcome.text.contains("switch the power of all boards off, wait 2 s"));
    boards.assert_waiting(RATE);
    outcome
}

fn two() -> Boards {
    Boards::new(RATE, &[0xFF, 0xFF])
}

#[test]
fn all_boards_come_back_after_power() {
    let outcome = check(&two(), &[0, 1]);
    assert_eq!((outcome.code, outcome.error.as_str()), (0, ""));
    assert!(outcome.text.ends_with("2 boards came back after power, at 125 kbit/s\n"));
}

#[test]
fn a_board_whose_power_was_not_switched_is_named() {
    let outcome = check(&two(), &[1]);
    assert_eq!(outcome.code, 1);
    let expected = "node 2 answers, but has not booted up: its power was not switched";
    let other = expected.replace('2', "1");
    assert!([expected, &other].contains(&outcome.error.as_str()), "{}", outcome.error);
}

#[test]
fn a_board_that_is_not_as_it_was_after_power_is_named() {
    let silent = " has not come back within 30 s: serial number 5FEAF9C5";
    let lost = ":5FEAF9C5 has no node-ID after power: it has not kept it";
    let moved =
        "node 1 has stored 500 kbit/s, and the network runs at 125: `lss set-rate` is for all";
    let cut = |network: &mut Network| network.cut_wire(Source::Board(1));
    let erase = |network: &mut Network| {
        network.board_mut(1).set_flash(SETTINGS_OFFSET, &[0xFF; SETTINGS_LENGTH]);
    };
    let other_rate = |network: &mut Network| {
        let stored = flash_with(&[settings(1, BitRate::Kbit500)]);
        network.board_mut(1).set_flash(SETTINGS_OFFSET, &stored);
    };
    let deeds: [fn(&mut Network); 3] = [cut, erase, other_rate];
    let words: [&[&str]; 3] = [&[silent], &[silent, lost], &[moved]];
    for (deed, words) in deeds.into_iter().zip(words) {
        let boards = two();
        boards.after(22, deed);
        let outcome = check(&boards, &[0, 1]);
        assert_eq!((outcome.code, outcome.error.lines().count()), (1, words.len()));
        for (line, words) in outcome.error.lines().zip(words) {
            assert!(line.contains(words), "{}", outcome.error);
        }
    }
}

#[test]
fn it_gives_up_if_nobody_switches_the_power() {
    let outcome = check(&two(), &[]);
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.starts_with("no board has booted up within 120 s"), "{}", outcome.error);
}

#[test]
fn ctrl_c_ends_the_wait() {
    let boards = two();
    boards.interrupt_after(30);
    assert_eq!(check(&boards, &[]).code, 130);
}
