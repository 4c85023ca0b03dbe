//! A debugger that halts the core within a session: its node is back at once, and sends nothing that is out of date.

use crate::rig::*;

/// The time from the end of a halt to the first sign of the node.
const BACK: Time = Time::from_ms(100);

/// Halts the core for a time, in which the master asks; timers and CAN go on.
fn halt(rig: &mut ImageRig, span: Time) {
    let until = rig.network.now() + span;
    rig.collect(Time::ZERO);
    rig.network.board_mut(0).halt();
    rig.network.run_for(Time::from_ms(10));
    for request in ["5E", "5A", "640: 40 00 10 00 00 00 00 00", "000: 01 40", "5B"] {
        rig.send(request);
        rig.network.run_for(Time::from_ms(100));
    }
    rig.network.run_until(until);
    let sent = rig.collect(Time::ZERO);
    assert_eq!(sent, SILENCE, "while it was halted");
    rig.network.board_mut(0).resume();
}

/// The watchdog is frozen meanwhile: the rig does not allow a reset.
#[test]
fn after_a_halt_of_the_core_the_node_is_back_in_100_ms_without_old_answers() {
    // More than half a turn of the count of microseconds, and more than a whole one.
    for seconds in [2, 40 * 60, 75 * 60] {
        let mut rig = node_40(50);
        rig.nmt("80 40");
        rig.lss("04 01");
        halt(&mut rig, Time::from_s(seconds));
        let frames = rig.collect(BACK).texts();
        assert!((1..=3).contains(&frames.len()), "{seconds} s: {frames:?}");
        assert!(frames.iter().all(|frame| frame == "740: 7F"), "{seconds} s: {frames:?}");
        rig.collect(Time::from_s(10));
        let answers = rig.lss("5E").texts();
        assert_eq!(answers.iter().filter(|frame| frame.starts_with("7E4: 5E 40")).count(), 1);
    }
}

/// The person goes from breakpoint to breakpoint.
#[test]
fn many_halts_in_a_row_do_not_end_in_a_reset_by_the_watchdog() {
    let mut rig = node_40(50);
    rig.lss("04 01");
    for _ in 0..30 {
        halt(&mut rig, Time::from_s(2));
        rig.network.run_for(Time::from_ms(30));
    }
    rig.collect(Time::from_s(1));
    assert!(rig.lss("5E").texts().iter().any(|frame| frame.starts_with("7E4: 5E 40")));
}
