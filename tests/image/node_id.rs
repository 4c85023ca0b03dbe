//! The release image when its node-ID changes or is removed: waiting frames with the old one are dropped.

use crate::rig::*;

/// Node 5, operational, with a heartbeat.
fn node_5(bit_rate: BitRate, heartbeat_ms: u16) -> ImageRig {
    let mut rig = rig_with(settings(5, bit_rate).with_heartbeat_ms(heartbeat_ms));
    rig.transmit_command("01 05");
    rig
}

/// The frames that the board began to send from `since` on.
fn frames_of_board(rig: &ImageRig, since: Time) -> Vec<String> {
    rig.sent_by_boards(since).map(|sent| sent.frame.to_string()).collect()
}

/// Whether the command that ended at `end` removed a frame from its mailbox. A board receives it one bit earlier.
fn has_dropped(rig: &ImageRig, end: Time) -> bool {
    rig.did(0, end - rig.bit_time() * 2).any(|event| matches!(event.what, What::Aborted { .. }))
}

#[test]
fn on_a_loaded_bus_a_boot_up_with_a_new_node_id_ends_the_old_one() {
    let mut rig = node_5(BitRate::Kbit500, 50);
    rig.lss("04 01, 11 04");
    // These frames wait behind urgent ones: an answer of LSS and one of SDO in mailboxes, heartbeats in the queue.
    let urgent = Frame::data(Id::Standard(0x001), &[0x55; 8]);
    let inquire = on_the_wire(&frames::request("5E"));
    let read = on_the_wire(&sdo::request(5, "40 17 10 00"));
    let reset = on_the_wire(&frames::command("82 00"));
    let load = [urgent; 250].into_iter();
    let frames = load.clone().chain([inquire, read]).chain(load).chain([reset]).chain([urgent; 8]);
    frames.for_each(|frame| rig.network.send(rig.master, frame));
    while rig.network.adapter_mut(rig.master).unsent() > 0 {
        rig.network.run_for(Time::from_us(100));
    }
    let end = rig.sent(Time::ZERO).find(|sent| sent.frame == reset).expect("the reset").end;
    assert!(has_dropped(&rig, end));
    rig.network.run_for(Time::from_ms(49));
    let answer = "7E4#5E05000000000000";
    assert_eq!(frames_of_board(&rig, end), ["704#00", answer, "704#7F"]);
}

/// Configures node 5, and resets communication at each point of its heartbeat period; calls `check` with the frames
/// that the board begins to send after the reset.
fn reset_with_pending(node_id: &str, check: impl Fn(&[String])) {
    const HEARTBEAT_MS: u16 = 40;
    let mut rig = node_5(BitRate::Kbit10, HEARTBEAT_MS);
    let mut dropped = 0;
    for phase in 0..HEARTBEAT_MS {
        rig.lss(&format!("04 01, 11 {node_id}"));
        rig.collect(Time::from_ms(100));
        rig.network.run_until_received(rig.master, Time::from_ms(100)).expect("a heartbeat");
        rig.network.run_for(Time::from_ms(phase.into()));
        let end = rig.transmit_command("82 00");
        rig.collect(Time::from_ms(200));
        check(&frames_of_board(&rig, end));
        dropped += u32::from(has_dropped(&rig, end));
        rig.power_cycle(0);
    }
    assert!(dropped > 0, "no heartbeat fell due while the command was on the bus");
}

#[test]
fn a_node_that_loses_its_node_id_at_10_kbit_per_s_sends_nothing_more() {
    reset_with_pending("FF", |sent| assert_eq!(sent, SILENCE));
}

#[test]
fn a_node_that_changes_its_node_id_at_10_kbit_per_s_sends_as_the_new_one() {
    reset_with_pending("04", |sent| {
        assert_eq!(sent[0], "704#00");
        assert!(sent[1..].iter().all(|frame| frame == "704#7F"), "{sent:?}");
    });
}
