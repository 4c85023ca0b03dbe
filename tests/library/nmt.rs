//! NMT (CiA 301, 7.3.2): boot-up and heartbeat, the commands, the services of each state, the transitions between them.

use canopen_node::{BusEvent, Frame, nmt::State};
use testkit::{frames::SILENCE, node_rig::NodeRig, sdo::Client};

/// The commands to all nodes, with the resulting state and its heartbeat.
const STATES: [(&str, State, &str); 3] = [
    ("01 00", State::Operational, "740: 05"),
    ("02 00", State::Stopped, "740: 04"),
    ("80 00", State::PreOperational, "740: 7F"),
];

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
    assert_eq!(board.node.heartbeat_ms(), u16::MAX);
    assert_eq!(board.pass_ms(65_534), SILENCE);
    assert_eq!(board.pass_ms(1), ["740: 7F"]);
}

#[test]
fn a_node_that_was_silent_for_hours_begins_its_heartbeat_on_time() {
    // 35.8 minutes or more after the start, half a turn of the clock, past instants look like future ones.
    for hours_ms in [2_147_484, 2_200_000, 3_600_000, 4_294_968] {
        let mut board = NodeRig::with_heartbeat(0xFF, 1_000);
        assert_eq!(board.be_late_ms(hours_ms), SILENCE);
        board.configure("11 04");
        assert_eq!(board.lss("04 00"), ["704: 00"]);
        assert_eq!(board.pass_ms(999), SILENCE);
        assert_eq!(board.pass_ms(1), ["704: 7F"]);
    }
}

#[test]
fn a_store_that_ends_in_stopped_is_not_answered_by_sdo_but_by_lss() {
    let mut board = NodeRig::with_slow_stores();
    board.sdo("23 10 10 01 73 61 76 65");
    board.configure("17");
    board.nmt("02 00");
    assert_eq!(board.finish_store(), SILENCE);
    assert_eq!(board.finish_store(), ["17 00"]);
    assert_eq!(board.nmt("80 00"), SILENCE);
}

/// The NMT state after a bus-off, with this error behaviour; `None`: the default.
fn after_bus_off(command: &str, error_behaviour: Option<u8>) -> State {
    let mut board = NodeRig::with_heartbeat(0x40, 100);
    if let Some(value) = error_behaviour {
        board.download(0x1029, 1, &[value]).unwrap();
    }
    board.nmt(command);
    let before = board.node.nmt_state();
    let told = board.see(BusEvent::BusOff);
    let state = board.node.nmt_state();
    let (.., heartbeat) = STATES.into_iter().find(|(_, is, _)| *is == state).unwrap();
    let at_once = (state != before).then_some(heartbeat);
    assert_eq!(told, at_once.as_slice(), "the state that nobody has commanded");
    assert_eq!(board.pass_ms(100), [heartbeat]);
    board.nmt("01 00");
    // Events other than bus-off leave it there.
    for event in [BusEvent::Error, BusEvent::Acknowledged] {
        board.see(event);
        assert_eq!(board.node.nmt_state(), State::Operational, "it can be started again");
    }
    state
}

#[test]
fn a_bus_off_has_the_effect_of_the_error_behaviour() {
    for (command, state, _) in STATES {
        let left = if state == State::Operational { State::PreOperational } else { state };
        for (error_behaviour, expected) in
            [(None, left), (Some(0), left), (Some(1), state), (Some(2), State::Stopped)]
        {
            assert_eq!(after_bus_off(command, error_behaviour), expected, "{error_behaviour:?}");
        }
    }
}

#[test]
fn a_bus_off_of_a_node_without_a_node_id_leaves_it_in_initialisation() {
    let mut board = NodeRig::unconfigured();
    board.see(BusEvent::BusOff);
    assert_eq!(board.node.nmt_state(), State::Initialisation);
}

#[test]
fn nothing_answers_a_node_guarding_request_which_needs_a_remote_frame() {
    let mut board = NodeRig::with_node_id(0x40);
    assert!(!board.node.receives().contains(0x740));
    assert_eq!(board.receive(&Frame::new(0x740, &[]).unwrap()), SILENCE);
}
