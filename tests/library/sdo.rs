//! The SDO server (CiA 301, 7.2.4) where no case can look: what a switch, a reset, a lost frame or an application does to a
//! transfer.

use canopen_node::{BusEvent, Frame, Instant, sdo::Abort};
use testkit::{
    frames::SILENCE,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::Client,
};

use crate::sdo_machine::{board, board_with_memory, bytes};

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

#[test]
fn a_value_that_changes_within_an_upload_is_read_as_it_was_at_the_beginning() {
    let mut board = board();
    board.download(0x2200, 2, b"The first text").unwrap();
    board.sdo("40 00 22 02");
    assert_eq!(board.sdo("60"), ["5C0: 00 54 68 65 20 66 69 72"]);
    board.node.application_mut().values.text = Default::default();
    assert_eq!(board.sdo("70"), ["5C0: 11 73 74 20 74 65 78 74"]);
    assert_eq!(board.upload(0x2200, 2).unwrap(), b"");
}

#[test]
fn the_application_refuses_a_domain_at_any_part_and_at_its_end() {
    let mut board = board();
    board.node.application_mut().refuse_part = Some(Abort::Memory);
    assert_eq!(board.download_segments(0x2300, 1, &bytes(20), None), Err(0x0504_0005));
    assert_eq!(board.download(0x2300, 1, &bytes(3)), Err(0x0504_0005));
    assert_eq!(board.block_download(0x2300, 1, &bytes(20)), Err(0x0504_0005));
    assert_eq!(board.node.application().aborted, 3);
    board.node.application_mut().refuse_part = None;
    board.node.application_mut().refuse_end = Some(Abort::Hardware);
    assert_eq!(board.download_segments(0x2300, 1, &bytes(20), None), Err(0x0606_0000));
    assert_eq!(board.download(0x2300, 1, &bytes(3)), Err(0x0606_0000));
    assert_eq!(board.block_download(0x2300, 1, &bytes(20)), Err(0x0606_0000));
    let machine = board.node.application();
    assert_eq!((machine.ended, machine.aborted, &machine.draft), (0, 6, &None));
}

#[test]
fn a_domain_that_becomes_shorter_while_it_is_read_is_0800_0024() {
    let mut board = board_with_memory(20);
    board.sdo("40 00 23 01");
    board.sdo("60");
    board.node.application_mut().memory.truncate(10);
    assert_eq!(board.sdo("70"), ["5C0: 80 00 23 01 24 00 00 08"]);
}

#[test]
fn errors_on_the_bus_that_drop_frames_do_not_disturb_the_next_transfer() {
    let mut board = board_with_memory(1000);
    board.is_acknowledged = false;
    board.sdo("A0 00 23 01 7F");
    board.sdo("A3");
    board.see(BusEvent::BusOff);
    board.is_acknowledged = true;
    board.see(BusEvent::BusOffRecovered);
    board.pass_ms(2000);
    assert_eq!(board.block_upload(0x2300, 1, 127).unwrap(), bytes(1000));
}
