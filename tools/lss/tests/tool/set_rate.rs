//! `lss set-rate`.

use canopen_node::BitRate;
use emulator::{Time, network::Source};
use testkit::image::Firmware;

use crate::{
    emulated::{Boards, Outcome, address_text},
    in_process::{At, Fault, Wire},
};

const OLD: BitRate = BitRate::Kbit125;
const NEW: BitRate = BitRate::Kbit500;
/// The indices of these bit rates.
const OLD_INDEX: u8 = 4;
const NEW_INDEX: u8 = 2;
/// The time between two heartbeats of boards that nobody has acknowledged yet.
const HEARTBEAT_MS: u16 = 1000;

#[test]
fn all_boards_follow_to_the_new_bit_rate_and_store_it() {
    let boards = Boards::new(OLD, &[1, 2, 0xFF, 4, 5]);
    let outcome = boards.lss("set-rate 500");
    assert_eq!(outcome.code, 0);
    assert_eq!(
        outcome.text,
        "plan: 5 boards from 125 kbit/s to 500 kbit/s\n\
         5 boards answered at 500 kbit/s and stored it\n"
    );
    for (board, id) in [1, 2, 0xFF, 4, 5].into_iter().enumerate() {
        assert_eq!(boards.stored(board), Some((id, NEW_INDEX)));
    }
    boards.assert_waiting(NEW);
    let list = boards.lss("list --bit-rate 500");
    assert_eq!((list.code, list.text.lines().count()), (0, 6));
}

/// Runs `set-rate 500` on three boards, of which the second is pulled out at the first frame with this command
/// specifier after `skipped` others; returns the error.
fn pull_out(specifier: u8, mut skipped: usize) -> (Boards, String) {
    let boards = Boards::new(OLD, &[1, 2, 3]);
    let mut is_out = false;
    boards.at_each_frame(move |frame, network| {
        if frame.cob_id() == 0x7E5 && frame.data().first() == Some(&specifier) && !is_out {
            if skipped == 0 {
                network.cut_wire(Source::Board(1));
                is_out = true;
            }
            skipped = skipped.saturating_sub(1);
        }
    });
    let outcome = boards.lss("set-rate 500");
    assert_eq!(outcome.code, 1, "{}", outcome.error);
    assert!(outcome.error.contains(&address_text(1)), "{}", outcome.error);
    boards.at_each_frame(|_, _| ());
    (boards, outcome.error)
}

/// Asserts that the other boards are at the old bit rate, that they have it stored, and that they switch again.
#[track_caller]
fn assert_old(boards: &Boards) {
    for board in [0, 2] {
        assert_eq!(boards.stored(board).map(|(_, index)| index), Some(OLD_INDEX));
    }
    boards.assert_waiting(OLD);
    let list = boards.lss("list");
    for board in [0, 2] {
        assert!(list.text.contains(&address_text(board)), "{}", list.text);
    }
}

#[test]
fn nothing_is_switched_if_a_board_is_pulled_out_before() {
    for skipped in 0..2 {
        let (boards, error) = pull_out(0x13, skipped);
        assert!(error.ends_with("; nothing was switched"), "{error}");
        assert_old(&boards);
    }
}

#[test]
fn all_others_go_back_if_a_board_is_pulled_out_at_the_switch() {
    let (boards, error) = pull_out(0x15, 0);
    assert!(error.starts_with("at 500 kbit/s: board "), "{error}");
    assert!(error.contains("Nothing is stored; at 125 kbit/s again: 2 boards, missing: "));
    assert_old(&boards);
}

#[test]
fn all_others_go_back_if_a_board_is_pulled_out_at_the_store() {
    for skipped in 0..2 {
        let (boards, error) = pull_out(0x17, skipped);
        assert!(error.contains("at 125 kbit/s again: 2 boards, missing: "), "{error}");
        assert_old(&boards);
    }
}

#[test]
fn a_board_that_is_only_deaf_for_the_switch_comes_back_too() {
    let boards = Boards::new(OLD, &[1, 2, 3]);
    boards.at_each_frame(|frame, network| {
        if frame.cob_id() == 0x7E5 && frame.data().first() == Some(&0x15) {
            network.cut_wire(Source::Board(1));
            network.run_for(Time::from_ms(5));
            network.mend_wire(Source::Board(1));
        }
    });
    let outcome = boards.lss("set-rate 500");
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.ends_with("at 125 kbit/s again: 3 boards"), "{}", outcome.error);
    assert_old(&boards);
    // Its pending bit rate is the old one, too: a store keeps it.
    boards.at_each_frame(|_, _| ());
    assert_eq!(boards.lss(&format!("store --address {}", address_text(1))).code, 0);
    assert_eq!(boards.stored(1).map(|(_, index)| index), Some(OLD_INDEX));
}

#[test]
fn ctrl_c_around_the_switch_leaves_all_boards_at_one_bit_rate() {
    for specifier in [0x13, 0x15] {
        let boards = Boards::new(OLD, &[1, 2, 3]);
        let flag = std::sync::Arc::clone(&boards.is_interrupted);
        boards.at_each_frame(move |frame, _| {
            if frame.cob_id() == 0x7E5 && frame.data().first() == Some(&specifier) {
                flag.store(true, std::sync::atomic::Ordering::Relaxed);
            }
        });
        let outcome = boards.lss("set-rate 500");
        assert_eq!(outcome.code, 130);
        assert!(
            outcome
                .text
                .ends_with("interrupted. Nothing is stored; at 125 kbit/s again: 3 boards\n")
        );
        boards.at_each_frame(|_, _| ());
        assert_old(&boards);
    }
}

#[test]
fn a_network_with_nobody_is_told() {
    assert_eq!(Boards::new(OLD, &[]).lss("set-rate 500").code, 3);
    assert_eq!(Boards::new(OLD, &[]).lss("set-rate 125").code, 3);
}

#[test]
fn a_board_that_listens_at_the_bit_rate_of_the_others_stores_it() {
    // The power was cut while they stored 500 kbit/s.
    let boards =
        Boards::unattended(Firmware::Default, &[(1, NEW), (2, NEW), (3, OLD)], HEARTBEAT_MS);
    boards.rig().network.run_for(Time::from_ms(30_000));
    let outcome = boards.lss("set-rate 500 --bit-rate 500");
    assert_eq!(outcome.code, 0, "{}", outcome.error);
    assert!(outcome.text.ends_with("3 boards answered at 500 kbit/s and stored it\n"));
    for (board, id) in [1, 2, 3].into_iter().enumerate() {
        assert_eq!(boards.stored(board), Some((id, NEW_INDEX)));
    }
    let list = boards.lss("list --bit-rate 500").text;
    assert!(list.contains("500") && !list.contains("home"), "{list}");
    boards.assert_waiting(NEW);
}

#[test]
fn whenever_a_board_is_pulled_out_the_others_have_stored_one_bit_rate() {
    // The LSS frames of a run without a fault from the first 13 on.
    let frames = std::rc::Rc::new(std::cell::Cell::new((0, None)));
    let seen = std::rc::Rc::clone(&frames);
    let boards = Boards::new(OLD, &[1, 2, 3]);
    boards.at_each_frame(move |frame, _| {
        let (count, first) = seen.get();
        let is_configure = frame.cob_id() == 0x7E5 && frame.data().first() == Some(&0x13);
        seen.set((count + 1, first.or(is_configure.then_some(count))));
    });
    assert_eq!(boards.lss("set-rate 500").code, 0);
    let (count, first) = frames.get();
    let first = first.expect("a configuration");
    assert!(count - first > 30, "{first} to {count}");

    for pulled_at in first..count {
        let boards = Boards::new(OLD, &[1, 2, 3]);
        let mut number = 0;
        boards.at_each_frame(move |_, network| {
            if number == pulled_at {
                network.cut_wire(Source::Board(1));
            }
            number += 1;
        });
        let outcome = boards.lss("set-rate 500");
        boards.at_each_frame(|_, _| ());
        let (rate, index) = if outcome.code == 0 { (NEW, NEW_INDEX) } else { (OLD, OLD_INDEX) };
        for board in [0, 2] {
            let stored = boards.stored(board).map(|(_, index)| index);
            assert_eq!(stored, Some(index), "board {board}, pulled out at {pulled_at}");
        }
        boards.assert_waiting(rate);
        let list = boards.lss(&format!("list --bit-rate {}", rate.kbit_per_s()));
        for board in [0, 2] {
            assert!(list.text.contains(&address_text(board)), "pulled out at {pulled_at}");
        }
    }
}

/// Runs `set-rate 500` on three boards again and again, with the fault one frame later each time from the first write
/// on, until it comes too late.
fn with_fault_at_each_frame(fault: Fault, mut check: impl FnMut(&Wire, &Outcome)) {
    for number in 0.. {
        let wire = Wire::new(OLD, &[1, 2, 3]);
        wire.fail_at(At::Frame(number), fault);
        let outcome = wire.lss("set-rate 500");
        if !wire.mend() {
            assert!(number > 30, "{number}");
            return;
        }
        check(&wire, &outcome);
    }
}

/// The bit rates that the boards have stored.
fn stored(wire: &Wire) -> Vec<BitRate> {
    let bus = wire.bus();
    let stored = bus.slaves.iter().map(|board| board.rig.stored().expect("settings").bit_rate);
    stored.map(|setting| BitRate::from_table(0, setting.index()).expect("a fixed one")).collect()
}

#[test]
fn another_lss_master_in_a_rate_change_is_told_at_a_safe_moment() {
    let mut outcomes = [0; 2];
    with_fault_at_each_frame(Fault::OtherMaster, |wire, outcome| {
        let is_done = outcome.text.contains("3 boards answered at 500 kbit/s and stored it");
        // At the last frame all is done.
        if outcome.code != 0 || !is_done {
            assert_eq!(outcome.code, 1, "{}", outcome.text);
            assert!(outcome.error.starts_with("two masters: "), "{}", outcome.error);
        }
        outcomes[usize::from(is_done)] += 1;
        let rate = if is_done { NEW } else { OLD };
        assert_eq!(stored(wire), [rate; 3]);
        assert!(wire.bit_rates().iter().all(|own| *own == rate));
        wire.assert_waiting();
    });
    assert!(outcomes.iter().all(|count| *count > 0), "{outcomes:?}");
}

#[test]
fn a_rate_change_without_its_adapter_says_where_the_boards_may_be() {
    let mut most = 0;
    with_fault_at_each_frame(Fault::AdapterGone, |wire, outcome| {
        let (error, stored) = (&outcome.error, stored(wire));
        let new = stored.iter().filter(|rate| **rate == NEW).count();
        // All had been done before the last frame.
        if (outcome.code, new) == (0, 3) {
            return;
        }
        assert_eq!(outcome.code, 4, "{}", outcome.text);
        most = most.max(new);
        if error.ends_with(
            "Nothing is stored: the boards are at 125 kbit/s, or at 500 kbit/s until their power is off",
        ) {
            assert_eq!(new, 0, "{error}");
        } else {
            let words = format!("All boards are at 500 kbit/s, and at least {new} of 3 have stored it");
            assert!(error.contains(&words), "{error}");
            assert!(error.ends_with("`lss set-rate 500 --bit-rate 500` lets all store it"));
            assert!(wire.bit_rates().iter().all(|own| *own == NEW));
        }
    });
    assert_eq!(most, 2);
}

#[test]
fn ctrl_c_while_the_boards_store_lets_all_of_them_store() {
    let mut done = 0;
    with_fault_at_each_frame(Fault::CtrlC, |wire, outcome| {
        let rate = if outcome.code == 0 { NEW } else { OLD };
        done += usize::from(outcome.code == 0);
        assert_eq!(stored(wire), [rate; 3]);
        assert!(wire.bit_rates().iter().all(|own| *own == rate));
    });
    assert!(done > 3, "{done}");
}
