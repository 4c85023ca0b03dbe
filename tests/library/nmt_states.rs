//! The services of each NMT state (CiA 301, 7.3.2), and the transitions between the states.

use canopen_node::{BusEvent, Frame, emergency::Fault, nmt::State};
use testkit::{
    flash::BoardFlash,
    frames::SILENCE,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::Client,
};

/// The commands to all nodes, with the resulting state and its heartbeat.
const STATES: [(&str, State, &str); 3] = [
    ("01 00", State::Operational, "740: 05"),
    ("02 00", State::Stopped, "740: 04"),
    ("80 00", State::PreOperational, "740: 7F"),
];

/// Every way to a boot-up.
#[derive(Clone, Copy, Debug)]
enum Reset {
    Power,
    Node(&'static str),
    Communication(&'static str),
}

const RESETS: [Reset; 5] = [
    Reset::Power,
    Reset::Node("81 00"),
    Reset::Node("81 40"),
    Reset::Communication("82 00"),
    Reset::Communication("82 40"),
];

#[test]
fn sdo_is_served_in_pre_operational_and_operational_only() {
    for (command, state, _) in STATES {
        let mut board = NodeRig::with_node_id(0x40);
        board.nmt(command);
        let answers = board.sdo("40 18 10 00");
        match state {
            State::Stopped => assert_eq!(answers, SILENCE),
            _ => assert_eq!(answers, ["5C0: 4F 18 10 00 04 00 00 00"], "{state:?}"),
        }
    }
}

#[test]
fn stopped_serves_nmt_and_lss_and_sends_only_heartbeats() {
    let mut board = NodeRig::with_heartbeat(0x40, 100);
    board.nmt("02 00");
    board.report(BusEvent::Overrun);
    for request in ["40 18 10 04", "2B 17 10 00 E8 03", "23 10 10 01 73 61 76 65", "40 08 10 00"] {
        assert_eq!(board.sdo(request), SILENCE);
    }
    assert_eq!(board.pass_ms(200), ["740: 04", "740: 04"], "neither SDO nor emergency");
    assert_eq!(board.stored(), None);

    assert_eq!(board.lss("04 01"), SILENCE);
    assert_eq!(board.lss("5E"), ["5E 40"]);
    assert_eq!(board.lss("11 04"), ["11 00"]);
    assert_eq!(board.lss("17"), ["17 00"]);
    assert_eq!(board.lss("04 00"), SILENCE);
    assert_eq!(board.node.nmt_state(), State::Stopped, "LSS does not change the NMT state");
    assert_eq!(board.nmt("82 00").0[0].data(), [0], "the boot-up first");
    assert_eq!(board.node.nmt_state(), State::PreOperational);
}

#[test]
fn a_request_in_stopped_is_not_answered_later() {
    let mut board = NodeRig::with_node_id(0x40);
    board.nmt("02 00");
    board.sdo("40 18 10 04");
    board.sdo("2B 17 10 00 0A 00");
    assert_eq!(board.nmt("80 00"), SILENCE);
    assert_eq!(board.pass_ms(1000), SILENCE);
    assert_eq!(board.sdo("40 17 10 00"), ["5C0: 4B 17 10 00 00 00 00 00"]);
}

#[test]
fn a_store_that_ends_in_stopped_is_not_answered_by_sdo_but_by_lss() {
    let mut board = NodeRig::with_node_id(0x40);
    board.let_stores_take_time();
    board.sdo("23 10 10 01 73 61 76 65");
    board.lss("04 01");
    board.lss("17");
    board.nmt("02 00");
    assert_eq!(board.finish_store(), SILENCE);
    assert_eq!(board.finish_store(), ["17 00"]);
    assert_eq!(board.nmt("80 00"), SILENCE);
}

#[test]
fn the_next_heartbeat_reports_a_new_state_and_is_sent_when_due() {
    for (from, ..) in STATES {
        for (to, _, heartbeat) in STATES {
            let mut board = NodeRig::with_heartbeat(0x40, 100);
            board.nmt(from);
            board.pass_ms(70);
            assert_eq!(board.nmt(to), SILENCE);
            assert_eq!(board.pass_ms(29), SILENCE);
            assert_eq!(board.pass_ms(1), [heartbeat]);
        }
    }
}

#[test]
fn every_reset_from_every_state_sends_one_boot_up_and_does_not_start() {
    for (command, ..) in STATES {
        for reset in RESETS {
            let mut board = NodeRig::with_heartbeat(0x40, 100);
            board.nmt(command);
            board.pass_ms(50);
            let sent = match reset {
                Reset::Power => board.power_cycle(),
                Reset::Node(reset) | Reset::Communication(reset) => board.nmt(reset),
            };
            assert_eq!(sent, ["740: 00"], "{command}, {reset:?}");
            assert_eq!(board.node.nmt_state(), State::PreOperational);
            assert_eq!(board.pass_ms(1_000).0.len(), 10);
            assert_eq!(board.node.nmt_state(), State::PreOperational);
        }
    }
}

#[test]
fn only_reset_node_resets_the_device() {
    let mut board = NodeRig::with_node_id(0x40);
    for (command, ..) in STATES {
        for reset in &RESETS[1..] {
            board.nmt(command);
            board.timeline();
            match reset {
                Reset::Node(command) => {
                    board.nmt(command);
                    assert_eq!(board.timeline(), ["0 ms reset", "0 ms 740: 00"]);
                }
                Reset::Communication(command) => {
                    board.nmt(command);
                    assert_eq!(board.timeline(), ["0 ms node-ID 40", "0 ms 740: 00"]);
                }
                Reset::Power => unreachable!(),
            }
        }
    }
}

#[test]
fn reset_communication_brings_back_the_stored_communication_parameters() {
    let mut board = NodeRig::with_heartbeat(0x40, 500);
    board.download(0x1017, 0, &1000_u16.to_le_bytes()).unwrap();
    board.nmt("82 00");
    assert_eq!(board.number(0x1017, 0), 500, "the default of the device");
    board.download(0x1017, 0, &1000_u16.to_le_bytes()).unwrap();
    board.download(0x1010, 1, b"save").unwrap();
    board.download(0x1017, 0, &2000_u16.to_le_bytes()).unwrap();
    board.nmt("82 00");
    assert_eq!(board.number(0x1017, 0), 1000, "the saved one");
    assert_eq!(board.pass_ms(1_000), ["740: 7F"]);
}

#[test]
fn a_first_node_id_by_lss_sends_one_boot_up_and_leads_to_pre_operational() {
    let mut board = NodeRig::unconfigured();
    board.nmt("01 00");
    board.lss("04 01");
    board.lss("11 40");
    assert_eq!(board.node.nmt_state(), State::Initialisation);
    assert_eq!(board.lss("04 00"), ["740: 00"]);
    assert_eq!(board.node.nmt_state(), State::PreOperational, "the start came too early");
    board.nmt("01 40");
    assert_eq!(board.node.nmt_state(), State::Operational);
}

#[test]
fn initialisation_obeys_no_command_but_the_resets_to_all() {
    let mut board = NodeRig::unconfigured();
    board.timeline();
    for command in ["01", "02", "80"] {
        for addressee in ["00", "40", "FF"] {
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
}

#[test]
fn a_pending_node_id_is_not_an_addressee_until_reset_communication() {
    let mut board = NodeRig::with_node_id(0x40);
    board.lss("04 01");
    board.lss("11 04");
    board.nmt("01 04");
    assert_eq!(board.node.nmt_state(), State::PreOperational);
    board.nmt("01 40");
    assert_eq!(board.node.nmt_state(), State::Operational);
    assert_eq!(board.nmt("82 40"), ["704: 00"]);
    board.nmt("01 40");
    assert_eq!(board.node.nmt_state(), State::PreOperational);
    board.nmt("01 04");
    assert_eq!(board.node.nmt_state(), State::Operational);
}

#[test]
fn the_last_command_in_a_switch_delay_is_obeyed_at_its_end() {
    for (command, state, _) in STATES {
        let mut board = NodeRig::with_node_id(0x40);
        board.nmt("01 00");
        board.lss("04 01");
        board.lss("13 00 02");
        board.lss("15 0A 00");
        board.nmt("80 00");
        board.nmt(command);
        board.pass_us(19_999);
        assert_eq!(board.node.nmt_state(), State::Operational);
        board.pass_us(1);
        assert_eq!(board.node.nmt_state(), state, "{command}");
        assert_eq!(board.bit_rate().kbit_per_s(), 500);
    }
}

#[test]
fn a_reset_in_a_switch_delay_wins_over_later_commands_that_are_none() {
    for reset in ["81 00", "82 40"] {
        let mut board = NodeRig::with_node_id(0x40);
        board.lss("04 01");
        board.lss("15 0A 00");
        board.nmt(reset);
        assert_eq!(board.nmt("01 00"), SILENCE);
        assert_eq!(board.pass_us(19_999), SILENCE);
        assert_eq!(board.pass_us(1), ["740: 00"]);
        assert_eq!(board.node.nmt_state(), State::PreOperational);
    }
}

#[test]
fn of_two_resets_in_a_switch_delay_that_of_the_node_counts() {
    let device = "20 ms reset";
    let communication = "20 ms node-ID 40";
    for (commands, done) in [
        (&["81 00", "82 00"][..], device),
        (&["82 00", "81 00"], device),
        (&["82 40", "81 40", "82 00", "01 00"], device),
        (&["82 00", "82 40", "80 00"], communication),
    ] {
        let mut board = NodeRig::with_node_id(0x40);
        board.lss("04 01");
        board.timeline();
        board.lss("15 0A 00");
        for command in commands {
            board.nmt(command);
        }
        board.pass_ms(20);
        let timeline = board.timeline();
        assert_eq!(timeline, ["0 ms stop", "20 ms resume", done, "20 ms 740: 00"], "{commands:?}");
    }
}

#[test]
fn after_a_boot_up_the_emergency_comes_before_the_heartbeat() {
    let settings = defaults(0x40).with_heartbeat_ms(1);
    let mut board = NodeRig::new(ADDRESS, settings, BoardFlash::blank(0), 0);
    board.node.handle_fault(Fault::SettingsLost);
    let reset = Frame::new(0x000, &[0x82, 0]).unwrap();
    assert_eq!(board.receive(&reset), ["740: 00", "0C0: 10 63 01 00 00 00 00 00"]);
    assert_eq!(board.pass_ms(1), ["740: 7F"]);
}

/// The NMT state after a bus-off, with this error behaviour; `None`: the default.
fn after_bus_off(command: &str, error_behaviour: Option<u8>) -> State {
    let mut board = NodeRig::with_heartbeat(0x40, 100);
    if let Some(value) = error_behaviour {
        board.download(0x1029, 1, &[value]).unwrap();
    }
    board.nmt(command);
    assert_eq!(board.see(BusEvent::BusOff), SILENCE);
    let state = board.node.nmt_state();
    let (.., heartbeat) = STATES.into_iter().find(|(_, is, _)| *is == state).unwrap();
    assert_eq!(board.pass_ms(100), [heartbeat]);
    state
}

#[test]
fn a_bus_off_in_operational_leads_to_pre_operational_by_default() {
    for (command, state, _) in STATES {
        let expected = if state == State::Operational { State::PreOperational } else { state };
        assert_eq!(after_bus_off(command, None), expected);
        assert_eq!(after_bus_off(command, Some(0)), expected);
    }
}

#[test]
fn with_error_behaviour_1_a_bus_off_leaves_the_nmt_state_alone() {
    for (command, state, _) in STATES {
        assert_eq!(after_bus_off(command, Some(1)), state);
    }
}

#[test]
fn with_error_behaviour_2_a_bus_off_stops_the_node() {
    for (command, ..) in STATES {
        assert_eq!(after_bus_off(command, Some(2)), State::Stopped);
    }
}

#[test]
fn a_node_that_bus_off_took_out_of_operational_can_be_started_again() {
    let mut board = NodeRig::with_node_id(0x40);
    board.nmt("01 00");
    board.see(BusEvent::BusOff);
    board.nmt("01 00");
    assert_eq!(board.node.nmt_state(), State::Operational);
    // Events other than bus-off leave it there.
    for event in [BusEvent::Error, BusEvent::Acknowledged] {
        board.see(event);
        assert_eq!(board.node.nmt_state(), State::Operational, "{event:?}");
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

/// A board with node-ID 40h and a heartbeat every second that detects its bit rate since an activation.
fn listening_board() -> NodeRig {
    let device = device(ADDRESS);
    let device = device.with_bit_rates(device.bit_rates.with_automatic());
    let settings = defaults(0x40).with_heartbeat_ms(1_000);
    let mut board = NodeRig::with_device(device.with_defaults(settings), BoardFlash::blank(0), 0);
    for request in ["04 01", "13 00 09", "15 00 00"] {
        board.lss(request);
    }
    assert!(board.node.is_listening());
    board
}

#[test]
fn a_node_that_detects_its_bit_rate_is_silent_then_sends_its_heartbeat() {
    let mut board = listening_board();
    board.report(BusEvent::Overrun);
    assert_eq!(board.pass_ms(20_000), SILENCE);
    let sent = ["0C0: 10 81 11 00 00 00 00 00", "0C0: 00 00 00 00 00 00 00 00", "740: 7F"];
    assert_eq!(board.see(BusEvent::Received), sent);
    assert_eq!(board.pass_us(999_999), SILENCE);
    assert_eq!(board.pass_us(1), ["740: 7F"]);
}

#[test]
fn a_node_that_listened_for_hours_goes_on_with_its_heartbeat_at_once() {
    // 35.8 minutes or more after the last heartbeat, half a turn of the clock, past instants look like future ones.
    for minutes in [30, 36, 60, 71, 120] {
        let mut board = listening_board();
        for _ in 0..3 * minutes {
            board.see(BusEvent::Error);
            assert_eq!(board.pass_ms(20_000), SILENCE);
        }
        assert_eq!(board.see(BusEvent::Received), ["740: 7F"], "after {minutes} minutes");
        assert_eq!(board.pass_ms(1_000), ["740: 7F"]);
    }
}
