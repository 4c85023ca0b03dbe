//! The activation of a bit rate, with its two silent periods (CiA 305, activate bit timing parameters).

use canopen_node::{BitRate, nmt::State};
use testkit::{
    frames::{self, SILENCE},
    node_rig::NodeRig,
};

/// A board in LSS configuration state that has just answered `13 00 02` (500 kbit/s), with an empty timeline.
fn ready_to_switch(heartbeat_ms: u16) -> NodeRig {
    in_configuration(NodeRig::with_heartbeat(0x40, heartbeat_ms))
}

fn in_configuration(mut board: NodeRig) -> NodeRig {
    assert_eq!(board.configure("13 00 02"), ["13 00"]);
    board.timeline();
    board
}

#[test]
fn delay_0_switches_and_sends_at_once_and_does_not_close_can_for_good() {
    let mut board = ready_to_switch(100);
    assert_eq!(board.lss("15 00 00"), ["740: 7F"]);
    let timeline = ["0 ms drop all", "0 ms 500 kbit/s", "0 ms 740: 7F"];
    assert_eq!(board.timeline(), timeline);
    assert_eq!(board.lss("5E"), ["5E 40"]);
    assert_eq!(board.pass_ms(100), ["740: 7F"]);
}

#[test]
fn the_node_is_as_before_after_an_activation() {
    for (command, heartbeat) in [("80 00", "740: 7F"), ("01 00", "740: 05"), ("02 00", "740: 04")] {
        let mut board = ready_to_switch(10_000);
        board.nmt(command);
        board.lss("15 64 00");
        assert_eq!(board.pass_ms(200), [heartbeat], "no boot-up, but a heartbeat at once");
        assert_eq!(board.lss("5E"), ["5E 40"], "still LSS configuration state");
        assert_eq!(board.pass_ms(9_999), SILENCE);
        assert_eq!(board.pass_ms(1), [heartbeat], "the period counts from there");
    }
}

#[test]
fn a_node_without_a_node_id_stays_silent_after_an_activation() {
    let mut board = in_configuration(NodeRig::with_heartbeat(0xFF, 100));
    board.lss("15 64 00");
    assert_eq!(board.pass_ms(1000), SILENCE);
    assert_eq!(board.bit_rate(), BitRate::Kbit500);
    assert_eq!(board.node.nmt_state(), State::Initialisation);
    assert_eq!(board.lss("5E"), ["5E FF"]);
}

#[test]
fn lss_requests_are_ignored_in_the_silent_periods_and_served_at_their_end() {
    let requests = ["04 00", "11 05", "13 00 03", "15 00 00", "17", "5E", "51 00 00 00 00 80"];
    for request in requests {
        for at_us in [0, 1, 99_999, 100_000, 100_001, 199_999] {
            let mut board = ready_to_switch(0);
            board.lss("15 64 00");
            board.pass_us(at_us);
            assert_eq!(board.lss(request), SILENCE, "{request} after {at_us} us");
            board.pass_us(200_000 - at_us);
            let timeline = ["0 ms drop all", "100 ms 500 kbit/s"];
            assert_eq!(board.timeline(), timeline, "{request} after {at_us} us");
            assert_eq!(board.lss("5E"), ["5E 40"], "{request} after {at_us} us");
            assert_eq!(board.nmt("82 00"), ["740: 00"], "{request} after {at_us} us");
            board.configure("15 00 00");
            assert_eq!(board.bit_rate(), BitRate::Kbit500, "{request} after {at_us} us");
        }
    }
}

#[test]
fn a_second_activation_starts_again_when_the_first_has_ended() {
    let mut board = ready_to_switch(0);
    board.lss("15 64 00");
    board.pass_ms(150);
    board.lss("15 E8 03");
    board.pass_ms(50);
    board.lss("13 00 03");
    board.lss("15 0A 00");
    board.pass_ms(100);
    let timeline = [
        "0 ms drop all",
        "100 ms 500 kbit/s",
        "200 ms 7E4: 13 00 00 00 00 00 00 00",
        "200 ms drop all",
        "210 ms 250 kbit/s",
    ];
    assert_eq!(board.timeline(), timeline);
}

#[test]
fn the_last_nmt_command_of_the_silent_periods_is_carried_out_at_their_end_and_a_reset_wins() {
    const OF_NODE: [&str; 2] = ["200 ms reset", "200 ms 740: 00"];
    const OF_COMMUNICATION: [&str; 2] = ["200 ms node-ID 40", "200 ms 740: 00"];
    for (commands, carried_out, kbit_per_s) in [
        (&["01 00"][..], &["200 ms 740: 05"][..], 500),
        // 41 is another node.
        (&["01 00", "02 40", "01 41"], &["200 ms drop", "200 ms 740: 04"], 500),
        (&["82 00", "01 00"], &OF_COMMUNICATION, 500),
        (&["01 00", "82 40"], &OF_COMMUNICATION, 500),
        (&["82 00", "82 40", "80 00"], &OF_COMMUNICATION, 500),
        (&["81 00", "01 00"], &OF_NODE, 1000),
        (&["02 00", "81 00"], &OF_NODE, 1000),
        (&["82 00", "81 00"], &OF_NODE, 1000),
        (&["81 00", "82 00"], &OF_NODE, 1000),
        (&["82 40", "81 40", "82 00", "01 00"], &OF_NODE, 1000),
    ] {
        for at_ms in [0, 50, 100, 199] {
            let mut board = ready_to_switch(10_000);
            board.lss("15 64 00");
            board.nmt(commands[0]);
            board.pass_ms(at_ms);
            for command in commands {
                assert_eq!(board.nmt(command), SILENCE);
                assert_eq!(board.node.nmt_state(), State::PreOperational, "not yet");
            }
            board.pass_ms(10_000 - at_ms);
            let switch = ["0 ms drop all", "100 ms 500 kbit/s"];
            assert_eq!(board.timeline(), [&switch[..], carried_out].concat(), "{commands:?}");
            assert_eq!(board.bit_rate().kbit_per_s(), kbit_per_s, "{commands:?}");
            let is_reset = carried_out.contains(&"200 ms 740: 00");
            assert_eq!(board.is_in_configuration_state(), !is_reset, "{commands:?}");
            assert!(!is_reset || board.node.nmt_state() == State::PreOperational);
        }
    }
}

#[test]
fn a_reset_of_the_silent_periods_reaches_a_node_without_a_node_id() {
    let mut board = in_configuration(NodeRig::unconfigured());
    board.lss("11 04");
    board.lss("15 64 00");
    board.nmt("82 00");
    assert_eq!(board.pass_ms(199), SILENCE);
    assert_eq!(board.pass_ms(1), ["704: 00"]);
}

#[test]
fn a_store_that_ends_in_the_silent_periods_is_answered_at_their_end_by_lss_and_not_by_sdo() {
    let save = testkit::sdo::request(0x40, "23 10 10 01 73 61 76 65");
    for (request, answers) in [(frames::request("17"), &["17 00"][..]), (save, &[])] {
        let mut board = ready_to_switch(0);
        board.let_stores_take_time();
        assert_eq!(board.receive(&request), SILENCE);
        board.lss("15 64 00");
        board.pass_ms(50);
        assert_eq!(board.finish_store(), SILENCE);
        assert_eq!(board.pass_ms(149), SILENCE);
        assert_eq!(board.pass_ms(1), answers);
        assert_eq!(board.pass_ms(1000), SILENCE);
    }
}

#[test]
fn a_late_call_runs_due_actions_in_order_and_does_not_shift_later_ones() {
    let mut board = ready_to_switch(10);
    board.lss("15 64 00");
    assert_eq!(board.be_late_ms(150), SILENCE);
    board.pass_us(50_000);
    assert_eq!(board.timeline(), ["0 ms drop all", "150 ms 500 kbit/s", "200 ms 740: 7F"]);
    board.lss("15 64 00");
    assert_eq!(board.be_late_ms(300), ["740: 7F"]);
    assert_eq!(board.timeline(), ["0 ms drop all", "300 ms 740: 7F"]);
}

#[test]
fn answers_before_an_activation_are_handed_over_before_the_silence() {
    let mut board = NodeRig::with_node_id(0x40);
    board.timeline();
    assert_eq!(board.configure("5E, 13 00 02, 15 64 00"), ["5E 40", "13 00"]);
    assert_eq!(board.timeline().last().unwrap(), "0 ms drop all");
}
