//! Requests that the SDO server refuses, with their abort codes (CiA 301, table 22); no client blocks it.

use canopen_node::{BusEvent, Frame, Instant};
use testkit::{
    flash::BoardFlash,
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
fn an_object_that_does_not_exist_is_0602_0000() {
    let mut board = NodeRig::with_node_id(0x40);
    assert_eq!(board.sdo("40 34 12 01"), ["5C0: 80 34 12 01 00 00 02 06"], "read");
    assert_eq!(board.sdo("23 34 12 01 01 02 03 04"), ["5C0: 80 34 12 01 00 00 02 06"], "written");
    assert_eq!(board.sdo("21 34 12 01 08"), ["5C0: 80 34 12 01 00 00 02 06"], "in segments");
    assert_serves(&mut board);
}

#[test]
fn a_missing_sub_index_is_0609_0011() {
    let mut board = NodeRig::with_node_id(0x40);
    assert_eq!(board.sdo("40 18 10 05"), ["5C0: 80 18 10 05 11 00 09 06"]);
    assert_eq!(board.sdo("40 00 10 01"), ["5C0: 80 00 10 01 11 00 09 06"]);
    assert_eq!(board.sdo("23 10 10 04 73 61 76 65"), ["5C0: 80 10 10 04 11 00 09 06"]);
    assert_eq!(board.sdo("2B 17 10 FF E8 03"), ["5C0: 80 17 10 FF 11 00 09 06"]);
    assert_serves(&mut board);
}

#[test]
fn writing_a_read_only_object_is_0601_0002() {
    let mut board = NodeRig::with_node_id(0x40);
    assert_eq!(board.sdo("23 18 10 04 01 00 00 00"), ["5C0: 80 18 10 04 02 00 01 06"]);
    assert_eq!(board.sdo("2F 01 10 00 00"), ["5C0: 80 01 10 00 02 00 01 06"]);
    assert_eq!(board.sdo("23 14 10 00 81 00 00 80"), ["5C0: 80 14 10 00 02 00 01 06"]);
    // Whatever the length, and in segments.
    assert_eq!(board.sdo("2F 18 10 04 01"), ["5C0: 80 18 10 04 02 00 01 06"]);
    assert_eq!(board.sdo("21 08 10 00 20"), ["5C0: 80 08 10 00 02 00 01 06"]);
    assert_serves(&mut board);
}

#[test]
fn more_data_than_the_object_holds_is_0607_0012() {
    let mut board = NodeRig::with_node_id(0x40);
    assert_eq!(board.sdo("23 17 10 00 E8 03 00 00"), ["5C0: 80 17 10 00 12 00 07 06"]);
    assert_eq!(board.sdo("27 17 10 00 E8 03 00"), ["5C0: 80 17 10 00 12 00 07 06"]);
    assert_eq!(board.sdo("21 17 10 00 03"), ["5C0: 80 17 10 00 12 00 07 06"], "announced");
    assert_eq!(board.sdo("21 17 10 00 FF FF FF FF"), ["5C0: 80 17 10 00 12 00 07 06"]);
    assert_eq!(board.sdo("21 10 10 01 05"), ["5C0: 80 10 10 01 12 00 07 06"]);
    assert_eq!(board.number(0x1017, 0), 0, "nothing has been written");
    assert_serves(&mut board);
}

#[test]
fn less_data_than_the_object_holds_is_0607_0013() {
    let mut board = NodeRig::with_node_id(0x40);
    assert_eq!(board.sdo("2F 17 10 00 E8"), ["5C0: 80 17 10 00 13 00 07 06"]);
    assert_eq!(board.sdo("2B 10 10 01 73 61"), ["5C0: 80 10 10 01 13 00 07 06"]);
    assert_eq!(board.sdo("21 17 10 00 01"), ["5C0: 80 17 10 00 13 00 07 06"], "announced");
    assert_eq!(board.sdo("21 17 10 00 00"), ["5C0: 80 17 10 00 13 00 07 06"]);
    assert_eq!(board.number(0x1017, 0), 0, "nothing has been written");
    assert_serves(&mut board);
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
fn a_repeated_toggle_bit_is_0503_0000_and_ends_the_transfer() {
    let mut board = NodeRig::with_node_id(0x40);
    board.sdo("40 08 10 00");
    assert_eq!(board.sdo("70"), ["5C0: 80 08 10 00 00 00 03 05"], "the first one has 0");
    assert_eq!(board.sdo("60"), ["5C0: 80 00 00 00 01 00 04 05"]);

    board.sdo("40 08 10 00");
    board.sdo("60");
    assert_eq!(board.sdo("60"), ["5C0: 80 08 10 00 00 00 03 05"]);
    assert_eq!(board.sdo("70"), ["5C0: 80 00 00 00 01 00 04 05"]);
    assert_serves(&mut board);
}

#[test]
fn a_signature_that_is_not_the_right_one_is_0800_0020() {
    let mut board = NodeRig::with_node_id(0x40);
    for signature in ["6C 6F 61 64", "65 76 61 73", "53 41 56 45", "00", "73 61 76"] {
        let request = format!("23 10 10 01 {signature}");
        assert_eq!(board.sdo(&request), ["5C0: 80 10 10 01 20 00 00 08"], "{request}");
    }
    for signature in ["73 61 76 65", "64 61 6F 6C", "00", "01"] {
        let request = format!("23 11 10 01 {signature}");
        assert_eq!(board.sdo(&request), ["5C0: 80 11 10 01 20 00 00 08"], "{request}");
    }
    assert_eq!(board.stored(), None);
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
fn a_client_that_stops_half_way_blocks_nothing() {
    for segments in 0..2 {
        for next in ["40 18 10 04", "2B 17 10 00 E8 03", "40 34 12 00", "40 08 10 00", "C0"] {
            let mut board = NodeRig::with_node_id(0x40);
            board.sdo("40 08 10 00");
            for segment in ["60", "70"].into_iter().take(segments) {
                board.sdo(segment);
            }
            board.pass_ms(1_000);
            assert_eq!(board.sdo(next).0.len(), 1, "{next}");
            assert_serves(&mut board);
        }
    }
}

#[test]
fn a_new_upload_begins_at_the_first_byte_with_toggle_0() {
    let mut board = NodeRig::with_node_id(0x40);
    board.sdo("40 08 10 00");
    board.sdo("60");
    board.sdo("40 08 10 00");
    assert_eq!(board.sdo("60"), ["5C0: 00 54 65 73 74 20 62 6F"]);
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
fn a_reset_ends_the_transfer() {
    for reset in ["81 00", "82 40"] {
        let mut board = NodeRig::with_node_id(0x40);
        board.sdo("40 08 10 00");
        board.sdo("60");
        assert_eq!(board.nmt(reset), ["740: 00"]);
        assert_eq!(board.sdo("70"), ["5C0: 80 00 00 00 01 00 04 05"]);
        assert_serves(&mut board);
    }
}

#[test]
fn a_reset_discards_a_request_that_waits_for_the_bus() {
    let device = device(ADDRESS).with_rescue(true).with_defaults(defaults(0x40));
    let mut board = NodeRig::with_device(device, BoardFlash::blank(0), 0);
    let request = Frame::new(0x640, &[0x40, 0x18, 0x10, 0x04, 0, 0, 0, 0]).unwrap();
    assert!(board.node.handle_frame(&request, Instant::from_micros(0)).is_none());
    board.report(BusEvent::BusOff);
    assert_eq!(board.nmt("82 00"), ["740: 00"]);
}
