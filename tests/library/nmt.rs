//! NMT (CiA 301): boot-up, heartbeat, and the commands that change the state.

use canopen_node::{Frame, nmt::State};
use testkit::{
    frames::SILENCE,
    node_rig::{NodeRig, defaults},
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
fn a_command_that_is_unknown_or_of_another_node_or_length_is_ignored() {
    let known = [0x01, 0x02, 0x80, 0x81, 0x82];
    let unknown = (0..=0xFF).filter(|command| !known.contains(command)).map(|command| [command, 0]);
    let of_others = (1..=0xFF)
        .filter(|&addressee| addressee != 0x40)
        .flat_map(|addressee| known.map(|command| [command, addressee]));
    let of_other_length = [0, 1, 3, 4, 5, 6, 7, 8]
        .into_iter()
        .flat_map(|len| known.map(|command| [command, 0, 0, 0, 0, 0, 0, 0][..len].to_vec()));
    let frames = unknown.chain(of_others).map(Vec::from).chain(of_other_length);
    let mut board = NodeRig::with_node_id(0x40);
    board.nmt("01 00");
    board.timeline();
    for data in frames {
        let frame = Frame::new(0x000, &data).expect("a frame");
        assert_eq!(board.receive(&frame), SILENCE, "{data:02X?}");
        assert_eq!(board.node.nmt_state(), State::Operational, "{data:02X?}");
    }
    assert_eq!(board.timeline(), SILENCE);
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
fn heartbeats_do_not_drift_when_calls_come_late_and_missed_ones_are_not_sent() {
    for (late_ms, next_ms, time) in [(130, 70, "200 ms"), (1_050, 100, "1150 ms")] {
        let mut board = NodeRig::with_heartbeat(0x40, 100);
        assert_eq!(board.be_late_ms(late_ms), ["740: 7F"]);
        assert_eq!(board.pass_ms(next_ms - 1), SILENCE);
        assert_eq!(board.pass_ms(1), ["740: 7F"], "at {time}");
    }
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
fn a_node_that_was_silent_for_hours_begins_its_heartbeat_on_time() {
    // 35.8 minutes or more after the start, half a turn of the clock, past instants look like future ones.
    for hours_ms in [2_147_484, 2_200_000, 3_600_000, 4_294_968] {
        let settings = defaults(0xFF).with_heartbeat_ms(1_000);
        let mut board = NodeRig::with_defaults(settings);
        assert_eq!(board.be_late_ms(hours_ms), SILENCE);
        board.configure("11 04");
        assert_eq!(board.lss("04 00"), ["704: 00"]);
        assert_eq!(board.pass_ms(999), SILENCE);
        assert_eq!(board.pass_ms(1), ["704: 7F"]);
    }
}
