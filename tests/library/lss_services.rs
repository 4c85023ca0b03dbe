//! Frames and LSS states (CiA 305): the answer to each request in each state, byte for byte.

use canopen_node::{Frame, nmt::State};
use testkit::{
    frames::{Frames, SILENCE, bytes, number},
    node_rig::{ADDRESS, NodeRig},
};

/// A request for each valid command specifier, and the answers of a new slave without a node-ID in the states waiting
/// and configuration.
const REQUESTS: [(&str, &[&str], &[&str]); 22] = [
    ("04", &[], &[]),
    ("04 01", &[], &[]),
    ("11 04", &[], &["11 00"]),
    ("13 00 02", &[], &["13 00"]),
    ("15 0A 00", &[], &[]),
    ("17", &[], &["17 00"]),
    ("40 44 33 22 11", &[], &[]),
    ("41 88 77 66 55", &[], &[]),
    ("42 03 02 01 00", &[], &[]),
    ("43 EF BE AD DE", &[], &[]),
    ("46 44 33 22 11", &[], &[]),
    ("47 88 77 66 55", &[], &[]),
    ("48 03 02 01 00", &[], &[]),
    ("49 03 02 01 00", &[], &[]),
    ("4A EF BE AD DE", &[], &[]),
    ("4B EF BE AD DE", &[], &[]),
    ("4C", &["50"], &["50"]),
    ("51 00 00 00 00 80", &["4F"], &[]),
    ("5A", &[], &["5A 44 33 22 11"]),
    ("5B", &[], &["5B 88 77 66 55"]),
    ("5C", &[], &["5C 03 02 01 00"]),
    ("5D", &[], &["5D EF BE AD DE"]),
];

#[test]
fn the_state_after_power_on_is_waiting() {
    let mut board = NodeRig::with_node_id(0x40);
    assert_eq!(board.lss("5E"), SILENCE);
}

#[test]
fn each_request_is_answered_only_where_the_table_says_so() {
    for (request, in_waiting, in_configuration) in REQUESTS {
        let mut board = NodeRig::unconfigured();
        assert_eq!(board.lss(request), in_waiting, "{request} in waiting");
        let mut board = NodeRig::unconfigured();
        board.lss("04 01");
        assert_eq!(board.lss(request), in_configuration, "{request} in configuration");
    }
}

#[test]
fn only_04_changes_the_state_at_once() {
    for (request, ..) in REQUESTS.iter().filter(|(request, ..)| !request.starts_with("04")) {
        let mut board = NodeRig::unconfigured();
        board.lss(request);
        assert!(!board.is_in_configuration_state(), "{request} in waiting");
        board.lss("04 01");
        board.lss(request);
        board.pass_ms(100);
        assert!(board.is_in_configuration_state(), "{request} in configuration");
    }
}

#[test]
fn a_request_that_waiting_does_not_allow_changes_nothing() {
    for request in ["11 04", "13 00 02", "15 00 00", "17"] {
        let mut board = NodeRig::unconfigured();
        board.timeline();
        assert_eq!(board.lss(request), SILENCE, "{request}");
        assert_eq!(board.timeline(), SILENCE, "{request}");
        board.lss("04 01");
        assert_eq!(board.lss("4C"), ["50"], "{request}: the pending node-ID is still FF");
        board.lss("15 00 00");
        assert_eq!(board.bit_rate().kbit_per_s(), 1000, "{request}: and the pending rate too");
    }
}

#[test]
fn switch_state_global_goes_to_configuration_and_back_without_an_answer() {
    let mut board = NodeRig::with_node_id(0x40);
    assert_eq!(board.lss("04 01"), SILENCE);
    assert_eq!(board.lss("5E"), ["5E 40"]);
    assert_eq!(board.lss("04 01"), SILENCE);
    assert_eq!(board.lss("5E"), ["5E 40"]);
    assert_eq!(board.lss("04 00"), SILENCE);
    assert_eq!(board.lss("5E"), SILENCE);
    assert_eq!(board.lss("04 00"), SILENCE);
    assert_eq!(board.lss("5E"), SILENCE);
}

#[test]
fn switch_state_global_with_any_other_mode_is_ignored() {
    let mut board = NodeRig::with_node_id(0x40);
    for mode in 2..=0xFF {
        assert_eq!(board.lss(&format!("04 {mode:02X}")), SILENCE);
        assert!(!board.is_in_configuration_state(), "mode {mode:02X}");
    }
    board.lss("04 01");
    for mode in 2..=0xFF {
        assert_eq!(board.lss(&format!("04 {mode:02X}")), SILENCE);
        assert!(board.is_in_configuration_state(), "mode {mode:02X}");
    }
}

#[test]
fn numbers_are_little_endian_and_reserved_bytes_of_an_answer_are_0() {
    let mut board = NodeRig::with_node_id(0x40);
    board.lss("04 01");
    for (command, part) in [
        ("5A", ADDRESS.vendor_id),
        ("5B", ADDRESS.product_code),
        ("5C", ADDRESS.revision_number),
        ("5D", ADDRESS.serial_number),
    ] {
        let answer = format!("{command} {} 00 00 00", number(part));
        assert_eq!(board.lss(command), [answer.as_str()]);
    }
    assert_eq!(board.lss("5E"), ["5E 40 00 00 00 00 00 00"]);
}

#[test]
fn reserved_bytes_of_a_request_are_ignored_and_not_echoed() {
    const X: &str = "A5 A5 A5 A5 A5 A5 A5";
    let mut board = NodeRig::unconfigured();
    assert_eq!(board.lss(&format!("4C {X}")), ["50"]);
    assert_eq!(board.lss("51 A5 A5 A5 A5 80 A5 A5"), ["4F"]);
    assert_eq!(board.lss("04 01 A5 A5 A5 A5 A5 A5"), SILENCE);
    assert_eq!(board.lss(&format!("5A {X}")), ["5A 44 33 22 11"]);
    assert_eq!(board.lss(&format!("5B {X}")), ["5B 88 77 66 55"]);
    assert_eq!(board.lss(&format!("5C {X}")), ["5C 03 02 01 00"]);
    assert_eq!(board.lss(&format!("5D {X}")), ["5D EF BE AD DE"]);
    assert_eq!(board.lss(&format!("5E {X}")), ["5E FF"]);
    assert_eq!(board.lss("11 04 A5 A5 A5 A5 A5 A5"), ["11 00"]);
    assert_eq!(board.lss("11 00 A5 A5 A5 A5 A5 A5"), ["11 01"]);
    assert_eq!(board.lss("13 00 02 A5 A5 A5 A5 A5"), ["13 00"]);
    assert_eq!(board.lss("13 00 05 A5 A5 A5 A5 A5"), ["13 01"]);
    assert_eq!(board.lss(&format!("17 {X}")), ["17 00"]);
    board.timeline();
    assert_eq!(board.lss("15 02 00 A5 A5 A5 A5 A5"), SILENCE);
    board.pass_ms(10);
    assert_eq!(board.timeline(), ["0 ms stop", "2 ms 500 kbit/s", "4 ms resume"]);
    assert_eq!(board.lss("04 00 A5 A5 A5 A5 A5 A5"), ["704: 00"]);
    for command in ["40 44 33 22 11", "41 88 77 66 55", "42 03 02 01 00"] {
        assert_eq!(board.lss(&format!("{command} A5 A5 A5")), SILENCE);
    }
    assert_eq!(board.lss("43 EF BE AD DE A5 A5 A5"), ["44"]);
    for command in ["46 44 33 22 11", "47 88 77 66 55", "48 03 02 01 00", "49 03 02 01 00"] {
        assert_eq!(board.lss(&format!("{command} A5 A5 A5")), SILENCE);
    }
    assert_eq!(board.lss("4A EF BE AD DE A5 A5 A5"), SILENCE);
    assert_eq!(board.lss("4B EF BE AD DE A5 A5 A5"), ["4F"]);
}

#[test]
fn requests_back_to_back_are_all_answered_in_their_order() {
    let mut board = NodeRig::with_node_id(0x40);
    let requests = ["04 01", "5A", "5B", "5C", "5D", "5E"];
    let sent: Vec<_> = requests.iter().flat_map(|request| board.lss(request).0).collect();
    let answers = ["5A 44 33 22 11", "5B 88 77 66 55", "5C 03 02 01 00", "5D EF BE AD DE", "5E 40"];
    assert_eq!(Frames(sent), answers);
}

#[test]
fn requests_are_answered_while_a_store_is_running_and_none_is_lost() {
    let mut board = NodeRig::with_node_id(0x40);
    board.let_stores_take_time();
    board.lss("04 01");
    assert_eq!(board.lss("11 05"), ["11 00"]);
    assert_eq!(board.lss("17"), SILENCE);
    assert_eq!(board.lss("5D"), ["5D EF BE AD DE"]);
    assert_eq!(board.lss("11 06"), ["11 00"]);
    assert_eq!(board.lss("17"), SILENCE);
    assert_eq!(board.lss("17"), SILENCE);
    assert_eq!(board.lss("04 00"), SILENCE);
    assert!(!board.is_in_configuration_state());
    assert_eq!(board.finish_store(), ["17 00"]);
    assert_eq!(board.finish_store(), ["17 00"]);
    assert_eq!(board.finish_store(), ["17 00"]);
    assert_eq!(board.power_cycle(), ["706: 00"]);
}

#[test]
fn a_command_specifier_that_is_no_request_is_ignored_in_both_states() {
    let is_request =
        |command: u8| command == 0x5E || REQUESTS.iter().any(|(r, ..)| bytes(r)[0] == command);
    for is_configuration in [false, true] {
        let mut board = NodeRig::unconfigured();
        board.lss(if is_configuration { "04 01" } else { "04 00" });
        board.timeline();
        for command in (0..=0xFF).filter(|&command| !is_request(command)) {
            for rest in ["", " 01", " 44 33 22 11", " 00 00 00 00 80"] {
                assert_eq!(board.lss(&format!("{command:02X}{rest}")), SILENCE);
            }
        }
        assert_eq!(board.timeline(), SILENCE);
        assert_eq!(board.is_in_configuration_state(), is_configuration);
        assert_eq!(board.lss("4C"), ["50"]);
    }
}

#[test]
fn a_request_without_all_eight_bytes_is_ignored() {
    for is_configuration in [false, true] {
        let mut board = NodeRig::unconfigured();
        board.lss(if is_configuration { "04 01" } else { "04 00" });
        board.timeline();
        for (request, ..) in REQUESTS {
            let mut data = bytes(request);
            data.resize(8, 0);
            for len in 0..8 {
                let frame = Frame::new(0x7E5, &data[..len]).unwrap();
                assert_eq!(board.receive(&frame), SILENCE, "{request}, DLC {len}");
            }
        }
        assert_eq!(board.timeline(), SILENCE);
        assert_eq!(board.is_in_configuration_state(), is_configuration);
        assert_eq!(board.lss("4C"), ["50"]);
    }
}

#[test]
fn a_request_with_another_cob_id_is_ignored() {
    let mut board = NodeRig::unconfigured();
    for cob_id in (0..=0x7FF).filter(|&cob_id| cob_id != 0x7E5) {
        let frame = Frame::new(cob_id, &[0x4C, 0, 0, 0, 0, 0, 0, 0]).unwrap();
        assert_eq!(board.receive(&frame), SILENCE, "{cob_id:03X}");
    }
    assert_eq!(board.lss("4C"), ["50"]);
}

#[test]
fn lss_is_served_in_every_nmt_state() {
    for (command, state) in
        [("80 00", State::PreOperational), ("01 00", State::Operational), ("02 00", State::Stopped)]
    {
        let mut board = NodeRig::with_node_id(0x40);
        board.nmt(command);
        assert_eq!(board.node.nmt_state(), state);
        board.lss("04 01");
        assert_eq!(board.lss("11 05"), ["11 00"], "{state:?}");
        assert_eq!(board.lss("5E"), ["5E 40"], "{state:?}");
        assert_eq!(board.lss("17"), ["17 00"], "{state:?}");
        assert_eq!(board.node.nmt_state(), state, "LSS does not change the NMT state");
    }
    let mut board = NodeRig::unconfigured();
    assert_eq!(board.node.nmt_state(), State::Initialisation);
    board.lss("04 01");
    assert_eq!(board.lss("5E"), ["5E FF"]);
}

#[test]
fn nmt_commands_other_than_resets_leave_the_lss_state_alone() {
    for command in ["80 00", "01 00", "02 00"] {
        let mut board = NodeRig::with_node_id(0x40);
        board.nmt(command);
        assert!(!board.is_in_configuration_state(), "{command}");
        board.lss("04 01");
        board.nmt(command);
        assert!(board.is_in_configuration_state(), "{command}");
    }
}

#[test]
fn both_nmt_resets_return_to_waiting() {
    for command in ["81 00", "82 00"] {
        let mut board = NodeRig::with_node_id(0x40);
        board.lss("04 01");
        board.nmt(command);
        assert!(!board.is_in_configuration_state(), "{command}");
    }
}

#[test]
fn identify_non_configured_is_answered_only_while_both_node_ids_are_ff() {
    let mut board = NodeRig::unconfigured();
    assert_eq!(board.lss("4C"), ["50"]);
    board.lss("04 01");
    assert_eq!(board.lss("4C"), ["50"]);
    board.lss("11 05");
    assert_eq!(board.lss("4C"), SILENCE, "active FF, pending 05");
    board.lss("11 FF");
    assert_eq!(board.lss("4C"), ["50"]);
    board.lss("11 05");
    board.lss("04 00");
    assert_eq!(board.lss("4C"), SILENCE, "active 05, pending 05");
    board.lss("04 01");
    board.lss("11 FF");
    assert_eq!(board.lss("4C"), SILENCE, "active 05, pending FF");
    board.lss("04 00");
    assert_eq!(board.lss("4C"), SILENCE, "active 05, pending FF, waiting");
    board.nmt("82 00");
    assert_eq!(board.lss("4C"), ["50"]);
}
