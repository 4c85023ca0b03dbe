//! NMT (CiA 301): boot-up, heartbeat, and the commands that change the state.

use canopen_node::{Frame, nmt::State};
use testkit::{
    flash::BoardFlash,
    frames::SILENCE,
    node_rig::{ADDRESS, NodeRig, defaults},
};

const COMMANDS: [(&str, State); 3] =
    [("01", State::Operational), ("02", State::Stopped), ("80", State::PreOperational)];

#[test]
fn power_on_with_a_node_id_sends_one_boot_up_and_leads_to_pre_operational() {
    for node_id in 1..=127 {
        let mut board = NodeRig::with_node_id(node_id);
        assert_eq!(board.node.nmt_state(), State::PreOperational);
        assert_eq!(board.timeline(), [format!("0 ms {:03X}: 00", 0x700 + u16::from(node_id))]);
        assert_eq!(board.pass_ms(10_000), SILENCE, "no heartbeat unless there is a time for it");
    }
}

#[test]
fn commands_to_all_or_the_own_node_id_work_in_every_state() {
    for (from, _) in COMMANDS {
        for (command, state) in COMMANDS {
            for addressee in ["00", "40"] {
                let mut board = NodeRig::with_node_id(0x40);
                board.nmt(&format!("{from} 00"));
                assert_eq!(board.nmt(&format!("{command} {addressee}")), SILENCE);
                assert_eq!(board.node.nmt_state(), state, "{from}, {command} {addressee}");
            }
        }
    }
}

#[test]
fn commands_to_another_node_are_ignored() {
    for command in ["01", "02", "81", "82"] {
        let mut board = NodeRig::with_node_id(0x40);
        board.timeline();
        for addressee in (1..=0xFF).filter(|&addressee| addressee != 0x40) {
            assert_eq!(board.nmt(&format!("{command} {addressee:02X}")), SILENCE);
        }
        assert_eq!(board.timeline(), SILENCE);
        assert_eq!(board.node.nmt_state(), State::PreOperational);
    }
}

#[test]
fn unknown_commands_are_ignored() {
    let mut board = NodeRig::with_node_id(0x40);
    board.nmt("01 00");
    board.timeline();
    for command in (0..=0xFF).filter(|command| ![0x01, 0x02, 0x80, 0x81, 0x82].contains(command)) {
        assert_eq!(board.nmt(&format!("{command:02X} 00")), SILENCE);
    }
    assert_eq!(board.timeline(), SILENCE);
    assert_eq!(board.node.nmt_state(), State::Operational);
}

#[test]
fn a_command_that_is_not_two_bytes_long_is_ignored() {
    let mut board = NodeRig::with_node_id(0x40);
    for len in [0, 1, 3, 4, 5, 6, 7, 8] {
        for command in [0x01, 0x02, 0x81, 0x82] {
            let frame = Frame::new(0x000, &[command, 0, 0, 0, 0, 0, 0, 0][..len]).unwrap();
            assert_eq!(board.receive(&frame), SILENCE, "DLC {len}");
        }
    }
    assert_eq!(board.node.nmt_state(), State::PreOperational);
}

#[test]
fn the_heartbeat_starts_again_with_each_boot_up() {
    let mut board = NodeRig::with_heartbeat(0x40, 100);
    for command in ["81 00", "82 00"] {
        board.pass_ms(50);
        assert_eq!(board.nmt(command), ["740: 00"]);
        assert_eq!(board.pass_ms(99), SILENCE);
        assert_eq!(board.pass_ms(1), ["740: 7F"]);
    }
}

#[test]
fn heartbeats_do_not_drift_when_calls_come_late() {
    let mut board = NodeRig::with_heartbeat(0x40, 100);
    assert_eq!(board.be_late_ms(130), ["740: 7F"]);
    assert_eq!(board.pass_ms(69), SILENCE);
    assert_eq!(board.pass_ms(1), ["740: 7F"], "at 200 ms");
}

#[test]
fn heartbeats_that_were_missed_are_not_sent_late() {
    let mut board = NodeRig::with_heartbeat(0x40, 100);
    assert_eq!(board.be_late_ms(1_050), ["740: 7F"]);
    assert_eq!(board.pass_ms(99), SILENCE);
    assert_eq!(board.pass_ms(1), ["740: 7F"]);
}

#[test]
fn the_shortest_and_the_longest_heartbeat_time_are_kept() {
    let mut board = NodeRig::with_heartbeat(0x40, 1);
    assert_eq!(board.pass_ms(1_000).0.len(), 1_000);
    let mut board = NodeRig::with_heartbeat(0x40, u16::MAX);
    assert_eq!(board.pass_ms(65_534), SILENCE);
    assert_eq!(board.pass_ms(1), ["740: 7F"]);
}

#[test]
fn heartbeats_go_on_for_hours() {
    let mut board = NodeRig::with_heartbeat(0x40, 10_000);
    let three_hours_ms = 3 * 3_600_000;
    assert_eq!(board.pass_ms(three_hours_ms).0.len(), 1_080);
}

#[test]
fn a_node_that_was_silent_for_hours_begins_its_heartbeat_on_time() {
    // 35.8 minutes or more after the start, half a turn of the clock, past instants look like future ones.
    for hours_ms in [2_147_484, 2_200_000, 3_600_000, 4_294_968] {
        let settings = defaults(0xFF).with_heartbeat_ms(1_000);
        let mut board = NodeRig::new(ADDRESS, settings, BoardFlash::blank(0), 0);
        assert_eq!(board.be_late_ms(hours_ms), SILENCE);
        board.lss("04 01");
        board.lss("11 04");
        assert_eq!(board.lss("04 00"), ["704: 00"]);
        assert_eq!(board.pass_ms(999), SILENCE);
        assert_eq!(board.pass_ms(1), ["704: 7F"]);
    }
}
