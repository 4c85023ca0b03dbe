//! The SDO server (CiA 301, 7.2.4) on the wire: its transfers, the states in which it serves them, and the requests that
//! it refuses, with their abort codes (table 22).

use canopen_node::{BusEvent, Frame, Instant, sdo::Abort};
use testkit::{
    frames::SILENCE,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::{self, Client},
};

/// A board with node-ID 40h and these names.
fn board_named(name: &'static str, hardware: &'static str, software: &'static str) -> NodeRig {
    let names = device(ADDRESS).with_name(name).with_versions(hardware, software);
    NodeRig::of(names.with_defaults(defaults(0x40)))
}

#[test]
fn reserved_bits_and_bytes_of_a_request_are_ignored() {
    let mut board = NodeRig::with_node_id(0x40);
    assert_eq!(board.sdo("5F 18 10 04 FF FF FF FF"), ["5C0: 43 18 10 04 EF BE AD DE"]);
    assert_eq!(board.sdo("3B 17 10 00 E8 03 FF FF"), ["5C0: 60 17 10 00 00 00 00 00"]);
    assert_eq!(board.sdo("40 17 10 00"), ["5C0: 4B 17 10 00 E8 03 00 00"]);
    assert_eq!(board.sdo("40 08 10 00"), ["5C0: 41 08 10 00 0A 00 00 00"]);
    assert_eq!(board.sdo("6F FF FF FF FF FF FF FF"), ["5C0: 00 54 65 73 74 20 62 6F"]);
}

#[test]
fn a_text_is_uploaded_in_segments_of_seven_bytes() {
    for (text, size, segments) in [
        ("", "00", &["0F 00 00 00 00 00 00 00"][..]),
        ("7 bytes", "07", &["01 37 20 62 79 74 65 73"]),
        ("Test board", "0A", &["00 54 65 73 74 20 62 6F", "19 61 72 64 00 00 00 00"]),
        ("fourteen bytes", "0E", &["00 66 6F 75 72 74 65 65", "11 6E 20 62 79 74 65 73"]),
    ] {
        let mut board = board_named(text, "", "");
        let announced = format!("5C0: 41 08 10 00 {size} 00 00 00");
        assert_eq!(board.sdo("40 08 10 00"), [announced.as_str()]);
        for (request, segment) in ["60", "70"].into_iter().zip(segments) {
            assert_eq!(board.sdo(request), [format!("5C0: {segment}").as_str()], "{text}");
        }
    }
}

#[test]
fn a_text_of_any_length_is_uploaded_completely() {
    const TEXT: &str = "A name that needs several segments, the last of which is not full.";
    for len in 0..=TEXT.len() {
        let mut board = board_named(&TEXT[..len], &TEXT[len..], TEXT);
        assert_eq!(board.upload(0x1008, 0).unwrap(), &TEXT.as_bytes()[..len]);
        assert_eq!(board.upload(0x1009, 0).unwrap(), &TEXT.as_bytes()[len..]);
        assert_eq!(board.upload(0x100A, 0).unwrap(), TEXT.as_bytes());
    }
}

#[test]
fn a_request_that_is_not_eight_bytes_long_is_ignored() {
    let mut board = NodeRig::with_node_id(0x40);
    for len in 0..8 {
        let request = Frame::new(0x640, &[0x40, 0x18, 0x10, 1, 0, 0, 0, 0][..len]).unwrap();
        assert_eq!(board.receive(&request), SILENCE, "DLC {len}");
    }
    // It does not disturb the transfer under way either.
    board.sdo("40 08 10 00");
    assert_eq!(board.receive(&Frame::new(0x640, &[0x80]).unwrap()), SILENCE);
    assert_eq!(board.sdo("60"), ["5C0: 00 54 65 73 74 20 62 6F"]);
}

#[test]
fn every_node_id_has_its_own_pair_of_cob_ids_and_others_are_not_noticed() {
    for node_id in 1..=127 {
        let mut board = NodeRig::with_node_id(node_id);
        assert_eq!(board.node.receives().services[2], 0x600 + u16::from(node_id));
        for other in (1..=127).filter(|&other| other != node_id) {
            assert_eq!(board.receive(&sdo::request(other, "40 18 10 00")), SILENCE);
        }
        let answer = format!("{:03X}: 4F 18 10 00 04 00 00 00", 0x580 + u16::from(node_id));
        let request = sdo::request(node_id, "40 18 10 00");
        let answers = board.receive(&request);
        assert_eq!(answers, [answer.as_str()]);
        assert_eq!(board.receive(&answers.0[0]), SILENCE);
    }
}

#[test]
fn sdo_follows_the_node_id_after_reset_communication_and_not_before() {
    let (old, new) = (sdo::request(0x40, "40 18 10 00"), sdo::request(0x04, "40 18 10 00"));
    let mut board = NodeRig::with_node_id(0x40);
    board.configure("11 04, 04 00");
    assert_eq!(board.receive(&old), ["5C0: 4F 18 10 00 04 00 00 00"]);
    assert_eq!(board.receive(&new), SILENCE);
    assert_eq!(board.nmt("82 00"), ["704: 00"]);
    assert_eq!(board.receive(&old), SILENCE);
    assert_eq!(board.receive(&new), ["584: 4F 18 10 00 04 00 00 00"]);
    assert_eq!(board.number(0x1014, 0), 0x84);
}

#[test]
fn a_node_without_a_node_id_serves_no_sdo_until_lss_gives_it_one() {
    let mut board = NodeRig::unconfigured();
    board.configure("11 04");
    for cob_id in 0x580..=0x6FF {
        let request = Frame::new(cob_id, &[0x40, 0x18, 0x10, 0, 0, 0, 0, 0]).unwrap();
        assert_eq!(board.receive(&request), SILENCE, "{cob_id:03X}");
    }
    assert_eq!(board.lss("04 00"), ["704: 00"]);
    assert_eq!(board.receive(&sdo::request(4, "40 18 10 00")), ["584: 4F 18 10 00 04 00 00 00"]);
}

#[test]
fn nothing_is_served_during_a_switch_delay_and_all_after_it() {
    let mut board = NodeRig::with_node_id(0x40);
    board.configure("13 00 02");
    assert_eq!(board.lss("15 0A 00"), SILENCE);
    for _ in 0..19 {
        assert_eq!(board.sdo("40 18 10 00"), SILENCE);
        assert_eq!(board.sdo("2B 17 10 00 E8 03"), SILENCE);
        assert_eq!(board.pass_ms(1), SILENCE);
    }
    assert_eq!(board.pass_ms(1), SILENCE, "and nothing is answered late");
    assert_eq!(board.sdo("40 18 10 00"), ["5C0: 4F 18 10 00 04 00 00 00"]);
    assert_eq!(board.number(0x1017, 0), 0, "the ignored request has written nothing");
}

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
            "23 18 10 04 01 00 00 00, 2F 01 10 00 00, 23 00 12 01 81 00 00 80, 2F 18 10 04 01, \
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
fn a_reset_discards_a_request_that_waits_for_the_bus() {
    let device = device(ADDRESS).with_rescue(true).with_defaults(defaults(0x40));
    let mut board = NodeRig::of(device);
    // The command comes first.
    let command = Frame::new(0x000, &[0x80, 0x40]).unwrap();
    let request = Frame::new(0x640, &[0x40, 0x18, 0x10, 0x04, 0, 0, 0, 0]).unwrap();
    for frame in [command, request] {
        assert!(board.node.handle_frame(&frame, Instant::from_micros(0)).is_none());
    }
    board.report(BusEvent::BusOff);
    assert_eq!(board.nmt("82 00"), ["740: 00"]);
}

#[test]
fn an_abort_code_is_written_with_its_reason_and_its_number() {
    for (code, words) in [
        (Abort::Toggle, "the toggle bit has not changed (05030000h)"),
        (Abort::NoObject, "no such object (06020000h)"),
        (Abort::NoData, "no data available (08000024h)"),
    ] {
        assert_eq!(code.to_string(), words);
    }
}
