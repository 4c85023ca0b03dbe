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
fn power_on_with_a_node_id_sends_one_boot_up_and_leads_to_pre_operational() {
    for node_id in 1..=127 {
        let mut board = NodeRig::with_node_id(node_id);
        assert_eq!(board.node.nmt_state(), State::PreOperational);
        assert_eq!(board.timeline(), [format!("0 ms {:03X}: 00", 0x700 + u16::from(node_id))]);
        assert_eq!(board.pass_ms(10_000), SILENCE, "no heartbeat unless there is a time for it");
    }
}

#[test]
fn commands_to_all_or_the_own_node_id_work_in_every_state_and_the_next_heartbeat_says_so() {
    for (from, ..) in STATES {
        for (command, state, heartbeat) in STATES {
            for addressee in ["00", "40"] {
                let mut board = NodeRig::with_heartbeat(0x40, 100);
                board.nmt(from);
                board.pass_ms(70);
                assert_eq!(board.nmt(&format!("{} {addressee}", &command[..2])), SILENCE);
                assert_eq!(board.node.nmt_state(), state, "{from}, {command} {addressee}");
                assert_eq!(board.pass_ms(29), SILENCE);
                assert_eq!(board.pass_ms(1), [heartbeat], "when it is due");
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
fn stopped_serves_nmt_and_sends_only_heartbeats() {
    let mut board = NodeRig::with_heartbeat(0x40, 100);
    board.nmt("02 00");
    board.report(BusEvent::Overrun);
    for request in ["40 18 10 04", "2B 17 10 00 E8 03", "23 10 10 01 73 61 76 65", "40 08 10 00"] {
        assert_eq!(board.sdo(request), SILENCE);
    }
    assert_eq!(board.pass_ms(200), ["740: 04", "740: 04"], "neither SDO nor emergency");
    assert_eq!(board.stored(), None);
    let overrun = ["0C0: 10 81 11 00 00 00 00 00", "0C0: 00 00 00 00 00 00 00 00"];
    assert_eq!(board.nmt("80 00"), overrun, "no request is answered later");
    assert_eq!(board.number(0x1017, 0), 100);
    board.nmt("02 00");
    assert_eq!(board.nmt("82 00").0[0].data(), [0], "the boot-up first");
    assert_eq!(board.node.nmt_state(), State::PreOperational);
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

#[test]
fn every_reset_from_every_state_sends_one_boot_up_and_does_not_start() {
    for (command, ..) in STATES {
        for (reset, timeline) in [
            (None, &["0 ms 740: 00"][..]),
            (Some("81 00"), &["0 ms reset", "0 ms 740: 00"]),
            (Some("81 40"), &["0 ms reset", "0 ms 740: 00"]),
            (Some("82 00"), &["0 ms node-ID 40", "0 ms 740: 00"]),
            (Some("82 40"), &["0 ms node-ID 40", "0 ms 740: 00"]),
        ] {
            let mut board = NodeRig::with_heartbeat(0x40, 100);
            board.nmt(command);
            board.pass_ms(50);
            board.timeline();
            let sent = match reset {
                None => board.power_cycle(),
                Some(reset) => board.nmt(reset),
            };
            assert_eq!(sent, ["740: 00"], "{command}, {reset:?}");
            assert_eq!(board.timeline(), timeline, "{command}, {reset:?}");
            assert_eq!(board.node.nmt_state(), State::PreOperational);
            assert_eq!(board.pass_ms(99), SILENCE, "the heartbeat starts again");
            assert_eq!(board.pass_ms(1), ["740: 7F"]);
            assert_eq!(board.pass_ms(900).0.len(), 9);
            assert_eq!(board.node.nmt_state(), State::PreOperational);
        }
    }
}

#[test]
fn initialisation_obeys_no_command_but_the_resets_to_all() {
    let mut board = NodeRig::with_heartbeat(0xFF, 100);
    assert_eq!(board.pass_ms(1000), SILENCE);
    board.timeline();
    for command in ["01", "02", "80"] {
        for addressee in ["00", "40", "7F", "FF"] {
            assert_eq!(board.nmt(&format!("{command} {addressee}")), SILENCE);
            assert_eq!(board.node.nmt_state(), State::Initialisation);
        }
    }
    for addressee in 1..=0xFF {
        board.nmt(&format!("81 {addressee:02X}"));
        board.nmt(&format!("82 {addressee:02X}"));
    }
    assert_eq!(board.timeline(), SILENCE);
    board.nmt("82 00");
    assert_eq!(board.timeline(), ["0 ms node-ID FF"]);
    board.nmt("81 00");
    assert_eq!(board.timeline(), ["0 ms reset"]);
    assert_eq!(board.node.nmt_state(), State::Initialisation);
    assert_eq!(board.pass_ms(1000), SILENCE);
    assert_eq!(board.lss("4C"), ["50"]);
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
