//! Runs that are cut short, and the next run.

use super::{
    fleet::{Fault, Fleet, crc_of, new, old},
    is_control,
};

/// The number of frames of a run on two boards, and the first of them that changes something.
fn frames() -> (usize, usize) {
    let fleet = Fleet::new(&[5, 6]);
    assert_eq!(fleet.update(&new(), "5 6").code, 0);
    let sent = fleet.sent();
    let first = sent.iter().position(|frame| frame.cob_id() == 0).expect("NMT");
    (first, sent.len())
}

/// Lets something go wrong at one in `step` frames, and runs again.
fn assert_goes_on(fault: Fault, step: usize, code: u8) {
    let (first, count) = frames();
    let [old, new] = [old(), new()].map(|file| Some(crc_of(&file)));
    // The first board has its program after half of them.
    let end = if code == 1 { count / 2 } else { count };
    for at in (first..end).step_by(step) {
        let fleet = Fleet::new(&[5, 6]);
        fleet.fail_at(at, fault);
        let outcome = fleet.update(&super::new(), "5 6");
        // At its last frames all is done.
        let is_done = fault == Fault::CtrlC && fleet.kept() == [new, new];
        let code = if is_done { 0 } else { code };
        assert_eq!(outcome.code, code, "frame {at} of {count}: {}", outcome.error);
        assert!(fleet.mend(), "frame {at}");
        // Without a master the boards end with a program that stays: a trial has three starts.
        if at % 3 == 0 {
            fleet.pass_s(200);
            assert!(fleet.kept().iter().all(|kept| [old, new].contains(kept)), "frame {at}");
        } else if fault != Fault::CtrlC {
            // After Ctrl-C the transfer has been ended; others end after a second.
            fleet.pass_s(2);
        }
        let outcome = fleet.update(&super::new(), "");
        assert_eq!((outcome.code, &*outcome.error), (0, ""), "frame {at} of {count}");
        assert_eq!(fleet.kept(), [new, new], "frame {at}");
        fleet.assert_waiting();
    }
}

#[test]
fn a_run_goes_on_after_ctrl_c_in_each_phase() {
    assert_goes_on(Fault::CtrlC, 17, 130);
}

#[test]
fn a_run_goes_on_after_the_adapter_was_lost_in_each_phase() {
    assert_goes_on(Fault::AdapterGone, 17, 4);
}

#[test]
fn a_run_goes_on_after_the_power_of_a_board_failed() {
    assert_goes_on(Fault::PowerCut(0), 23, 1);
}

#[test]
fn a_board_that_is_lost_does_not_keep_the_others_from_the_program() {
    let (first, _) = frames();
    let fleet = Fleet::new(&[5, 6]);
    fleet.fail_at(first + 100, Fault::PowerCut(0));
    let outcome = fleet.update(&new(), "5 6");
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.contains("node 5  ") && outcome.error.contains("does not answer"));
    assert_eq!(fleet.kept(), [None, Some(crc_of(&new()))]);
}

#[test]
fn a_program_on_trial_is_confirmed_by_the_next_run() {
    let (_, count) = frames();
    let fleet = Fleet::new(&[5, 6]);
    assert_eq!(fleet.update(&new(), "5 6").code, 0);
    let confirms = fleet.sent().iter().position(|frame| is_control(frame, 0x80));
    let fleet = Fleet::new(&[5, 6]);
    fleet.fail_at(confirms.expect("it was sent"), Fault::AdapterGone);
    assert_eq!(fleet.update(&new(), "5 6").code, 4);
    assert!(fleet.mend() && fleet.board(0).is_on_trial(), "{count} frames");
    let outcome = fleet.update(&new(), "5");
    assert_eq!(outcome.code, 0);
    assert!(outcome.text.ends_with("1.1, was on trial: confirmed\n"), "{}", outcome.text);
    assert_eq!(fleet.kept(), [new(), old()].map(|file| Some(crc_of(&file))));
}
