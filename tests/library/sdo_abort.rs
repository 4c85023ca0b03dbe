//! Requests that the SDO server refuses, with their abort codes (CiA 301, table 22); no client blocks it.

use canopen_node::{BusEvent, Frame, Instant};
use testkit::{
    frames::SILENCE,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::Client,
};

/// A board with node-ID 40h; checks that the next transfer works like the first.
fn assert_serves(board: &mut NodeRig) {
    assert_eq!(board.number(0x1018, 4), 0xDEAD_BEEF);
    assert_eq!(board.upload(0x1008, 0).unwrap(), b"Test board");
}

#[test]
fn a_refused_request_is_answered_by_the_abort_code_of_its_reason() {
    let mut board = NodeRig::with_node_id(0x40);
    for (reason, code, requests) in [
        (
            "the object does not exist",
            "00 00 02 06",
            "40 34 12 01, 23 34 12 01 01 02 03 04, 21 34 12 01 08",
        ),
        (
            "the sub-index does not exist",
            "11 00 09 06",
            "40 18 10 05, 40 00 10 01, 23 10 10 04 73 61 76 65, 2B 17 10 FF E8 03",
        ),
        (
            "the object is read only",
            "02 00 01 06",
            "23 18 10 04 01 00 00 00, 2F 01 10 00 00, 23 14 10 00 81 00 00 80, 2F 18 10 04 01, \
             21 08 10 00 20",
        ),
        (
            "there is more data than the object holds",
            "12 00 07 06",
            "23 17 10 00 E8 03 00 00, 27 17 10 00 E8 03 00, 21 17 10 00 03, \
             21 17 10 00 FF FF FF FF, 21 10 10 01 05",
        ),
        (
            "there is less data than the object holds",
            "13 00 07 06",
            "2F 17 10 00 E8, 2B 10 10 01 73 61, 21 17 10 00 01, 21 17 10 00 00",
        ),
        (
            "the signature is not the right one",
            "20 00 00 08",
            "23 10 10 01 6C 6F 61 64, 23 10 10 01 65 76 61 73, 23 10 10 01 53 41 56 45, \
             23 10 10 01 00, 23 10 10 01 73 61 76, 23 11 10 01 73 61 76 65, \
             23 11 10 01 64 61 6F 6C, 23 11 10 01 00, 23 11 10 01 01",
        ),
    ] {
        for request in requests.split(", ") {
            let abort = format!("5C0: 80 {} {code}", &request[3..11]);
            assert_eq!(board.sdo(request), [abort.as_str()], "{reason}: {request}");
        }
        assert_eq!(board.number(0x1017, 0), 0, "nothing has been written: {reason}");
        assert_eq!(board.stored(), None, "nothing has been stored: {reason}");
        assert_serves(&mut board);
    }
}

#[test]
fn a_segment_that_belongs_to_no_transfer_is_0504_0001() {
    let mut board = NodeRig::with_node_id(0x40);
    for segment in ["60", "70", "00", "10", "01"] {
        assert_eq!(board.sdo(segment), ["5C0: 80 00 00 00 01 00 04 05"], "{segment}");
    }
    board.upload(0x1008, 0).unwrap();
    assert_eq!(board.sdo("60"), ["5C0: 80 00 00 00 01 00 04 05"], "after the last segment");
    board.number(0x1018, 1);
    assert_eq!(board.sdo("60"), ["5C0: 80 00 00 00 01 00 04 05"], "after an expedited upload");
}

#[test]
fn every_command_that_is_not_known_is_0504_0001() {
    let mut board = NodeRig::with_node_id(0x40);
    for command in 0xE0..=0xFF_u8 {
        let request = format!("{command:02X} 17 10 00");
        assert_eq!(board.sdo(&request), ["5C0: 80 17 10 00 01 00 04 05"], "{request}");
    }
    for command in [0x00..=0x1F, 0x60..=0x7F, 0xA1..=0xA3, 0xC1..=0xC1_u8].into_iter().flatten() {
        let request = format!("{command:02X} 17 10 00");
        assert_eq!(board.sdo(&request), ["5C0: 80 00 00 00 01 00 04 05"], "{request}");
    }
    assert_serves(&mut board);
}

#[test]
fn an_abort_of_the_client_ends_its_transfer_and_is_not_answered() {
    let mut board = NodeRig::with_node_id(0x40);
    assert_eq!(board.sdo("80 08 10 00 00 00 04 05"), SILENCE, "without a transfer too");
    board.sdo("40 08 10 00");
    board.sdo("60");
    assert_eq!(board.sdo("80 08 10 00 00 00 04 05"), SILENCE);
    assert_eq!(board.sdo("70"), ["5C0: 80 00 00 00 01 00 04 05"]);
    assert_serves(&mut board);
}

#[test]
fn a_new_request_ends_the_transfer_even_if_it_is_refused() {
    let mut board = NodeRig::with_node_id(0x40);
    for request in ["40 18 10 04", "40 34 12 00", "23 17 10 00", "C0", "00"] {
        board.sdo("40 08 10 00");
        board.sdo(request);
        assert_eq!(board.sdo("60"), ["5C0: 80 00 00 00 01 00 04 05"], "{request}");
    }
}

#[test]
fn a_reset_discards_a_request_that_waits_for_the_bus() {
    let device = device(ADDRESS).with_rescue(true).with_defaults(defaults(0x40));
    let mut board = NodeRig::of(device);
    let request = Frame::new(0x640, &[0x40, 0x18, 0x10, 0x04, 0, 0, 0, 0]).unwrap();
    assert!(board.node.handle_frame(&request, Instant::from_micros(0)).is_none());
    board.report(BusEvent::BusOff);
    assert_eq!(board.nmt("82 00"), ["740: 00"]);
}
