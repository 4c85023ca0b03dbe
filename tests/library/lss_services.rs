//! Frames and LSS states (CiA 305): the answer to each request in each state, byte for byte.

use canopen_node::{Frame, nmt::State};
use testkit::{
    frames::{SILENCE, bytes},
    node_rig::NodeRig,
};

/// A request for each command specifier of a master.
const REQUESTS: &str = "04, 04 01, 11 04, 13 00 02, 15 0A 00, 17, 4C, 51 00 00 00 00 80, 5A, \
    5B, 5C, 5D, 5E, 40 44 33 22 11, 41 88 77 66 55, 42 03 02 01 00, 43 EF BE AD DE, \
    46 44 33 22 11, 47 88 77 66 55, 48 03 02 01 00, 49 03 02 01 00, 4A EF BE AD DE, 4B EF BE AD DE";

#[test]
fn reserved_bytes_of_a_request_are_ignored_and_not_echoed() {
    let mut board = NodeRig::unconfigured();
    for (request, answer) in [
        ("4C", Some("50")),
        ("51 00 00 00 00 80", Some("4F")),
        ("04 01", None),
        ("5A", Some("5A 44 33 22 11")),
        ("5B", Some("5B 88 77 66 55")),
        ("5C", Some("5C 03 02 01 00")),
        ("5D", Some("5D EF BE AD DE")),
        ("5E", Some("5E FF")),
        ("11 04", Some("11 00")),
        ("11 00", Some("11 01")),
        ("13 00 02", Some("13 00")),
        ("13 00 05", Some("13 01")),
        ("17", Some("17 00")),
        ("04 00", Some("704: 00")),
        ("40 44 33 22 11", None),
        ("41 88 77 66 55", None),
        ("42 03 02 01 00", None),
        ("43 EF BE AD DE", Some("44")),
        ("46 44 33 22 11", None),
        ("47 88 77 66 55", None),
        ("48 03 02 01 00", None),
        ("49 03 02 01 00", None),
        ("4A EF BE AD DE", None),
        ("4B EF BE AD DE", Some("4F")),
    ] {
        let mut data = bytes(request);
        data.resize(8, 0xA5);
        let request = Frame::new(0x7E5, &data).expect("eight bytes");
        assert_eq!(board.receive(&request), answer.as_slice(), "{request:?}");
    }
    board.timeline();
    assert_eq!(board.lss("15 02 00 A5 A5 A5 A5 A5"), SILENCE);
    board.pass_ms(10);
    assert_eq!(board.timeline(), ["0 ms drop all", "2 ms 500 kbit/s"]);
}

#[test]
fn requests_are_answered_while_a_store_is_running_and_none_is_lost() {
    let mut board = NodeRig::with_slow_stores();
    assert_eq!(
        board.configure("11 05, 17, 5D, 11 06, 17, 17, 04 00"),
        ["11 00", "5D EF BE AD DE", "11 00"]
    );
    assert!(!board.is_in_configuration_state());
    assert_eq!(board.finish_store(), ["17 00"]);
    assert_eq!(board.finish_store(), ["17 00"]);
    assert_eq!(board.finish_store(), ["17 00"]);
    assert_eq!(board.power_cycle(), ["706: 00"]);
}

#[test]
fn a_frame_that_is_no_request_of_the_standard_is_ignored_in_both_states() {
    let requests: Vec<_> = REQUESTS.split(", ").map(bytes).collect();
    let is_request = |command: &u8| requests.iter().any(|request| request[0] == *command);
    let others = (0..=0xFF).filter(|command| !is_request(command)).flat_map(|command| {
        ["", "01", "44 33 22 11", "00 00 00 00 80"]
            .map(|rest| [vec![command], bytes(rest)].concat())
    });
    let other_modes = (2..=0xFF).map(|mode| vec![0x04, mode]);
    let padded = |mut data: Vec<u8>| {
        data.resize(8, 0);
        data
    };
    let short = requests.iter().cloned().map(padded);
    let short = short.flat_map(|data| (0..8).map(move |len| data[..len].to_vec()));
    let ignored: Vec<_> = others.chain(other_modes).map(padded).chain(short).collect();
    let other_cob_ids = (0..=0x7FF).filter(|&cob_id| cob_id != 0x7E5);
    for state in ["04 00", "04 01"] {
        let mut board = NodeRig::unconfigured();
        board.lss(state);
        board.timeline();
        let of_master = ignored.iter().map(|data| Frame::new(0x7E5, data));
        let of_others = other_cob_ids.clone().map(|cob_id| Frame::new(cob_id, &[0x4C; 8]));
        for frame in of_master.chain(of_others).map(Option::unwrap) {
            assert_eq!(board.receive(&frame), SILENCE, "{frame:?}");
        }
        assert_eq!(board.timeline(), SILENCE);
        assert_eq!(board.is_in_configuration_state(), state == "04 01");
        assert_eq!(board.lss("4C"), ["50"]);
    }
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
    assert_eq!(board.configure("5E"), ["5E FF"]);
}
