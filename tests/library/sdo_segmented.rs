//! Expedited and segmented transfers: values of every type and length (CiA 301, 7.2.4.3).

use canopen_node::{
    BusEvent,
    object_dictionary::{Access, Entry, Object, TABLE},
    sdo::Abort,
};
use testkit::{frames::SILENCE, node_rig::NodeRig, sdo::Client};

use crate::sdo_machine::{CONSTANT, board, board_with_memory, bytes};

const TOO_LONG: u32 = 0x0607_0012;
const TOO_SHORT: u32 = 0x0607_0013;

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
fn strings_and_domains_of_any_length_are_written_and_read_back() {
    let mut board = board();
    for len in 0..=40 {
        let data = bytes(len);
        for announced in [None, Some(len as u32)] {
            board.download(0x2200, 3, b"?").unwrap();
            assert_eq!(board.download_segments(0x2200, 3, &data, announced), Ok(()));
            assert_eq!(board.upload(0x2200, 3).unwrap(), data);
        }
    }
    for len in 1..1000 {
        let data = bytes(len);
        assert_eq!(board.download_segments(0x2300, 1, &data, None), Ok(()));
        assert_eq!(board.upload(0x2300, 2).unwrap(), data);
    }
    assert_eq!(board.node.application().ended, 999);
    assert_eq!(board.node.application().aborted, 0);
    assert_eq!(board.upload(0x2200, 1).unwrap(), CONSTANT.as_bytes());
    assert_eq!(board.upload(0x1008, 0).unwrap(), b"Test board");
}

/// The value of a number that a client writes, as bytes: the present one, or the signature of a store.
fn legal_value(board: &mut NodeRig, entry: &Entry) -> Vec<u8> {
    match entry.object {
        Object::StoreParameters => b"save".to_vec(),
        Object::RestoreDefaultParameters => b"load".to_vec(),
        _ => board.upload(entry.index, entry.sub_index).unwrap(),
    }
}

#[test]
fn each_number_of_every_node_takes_a_download_in_segments() {
    let mut board = NodeRig::with_heartbeat(0x40, 20_000);
    let mut written = Vec::new();
    for entry in TABLE.iter().filter(|entry| entry.access == Access::ReadWrite) {
        let Entry { index, sub_index, .. } = *entry;
        let value = legal_value(&mut board, entry);
        for size in [None, Some(value.len() as u32)] {
            let outcome = board.download_segments(index, sub_index, &value, size);
            assert_eq!(outcome, Ok(()), "{index:04X} sub {sub_index}, size {size:?}");
        }
        for len in (0..=16).filter(|len| *len != value.len()) {
            let expected = Err(if len < value.len() { TOO_SHORT } else { TOO_LONG });
            for size in [None, Some(len as u32)] {
                let outcome = board.download_segments(index, sub_index, &bytes(len), size);
                assert_eq!(outcome, expected, "{index:04X} sub {sub_index}, {len} bytes");
            }
            // A last segment that does not say how many bytes count is as long as announced.
            if len % 7 == 0 && len.div_ceil(7) == value.len().div_ceil(7) {
                continue;
            }
            let announced = Some(value.len() as u32);
            let outcome = board.download_segments(index, sub_index, &bytes(len), announced);
            assert_eq!(outcome, expected, "{index:04X} sub {sub_index}, {len} bytes, announced");
        }
        written.push(index);
    }
    assert_eq!(board.number(0x1017, 0), 20_000);
    written.dedup();
    assert_eq!(written, [0x1003, 0x1010, 0x1011, 0x1014, 0x1015, 0x1017, 0x1020, 0x1029]);
}

#[test]
fn a_last_segment_that_says_no_length_has_what_was_announced() {
    for announced in 1..=21 {
        let mut board = board();
        board.sdo(&format!("21 00 23 01 {announced:02X}"));
        let segments =
            ["00 01 02 03 04 05 06 07", "10 08 09 0A 0B 0C 0D 0E", "01 0F 10 11 12 13 14 15"];
        let first = segments.len() - usize::div_ceil(announced, 7);
        // The toggle bit begins with 0.
        for (n, segment) in segments[first..].iter().enumerate() {
            let is_last = u8::from(n + first == 2);
            let answer =
                board.sdo(&format!("{:02X}{}", (n as u8 % 2) << 4 | is_last, &segment[2..]));
            assert_eq!(answer.0[0].data()[0], 0x20 | (n as u8 % 2) << 4);
        }
        let expected = (first * 7..).map(|at| at as u8 + 1).take(announced).collect::<Vec<_>>();
        assert_eq!(board.node.application().memory, expected, "{announced} bytes");
    }
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
fn after_a_second_without_a_message_the_server_aborts_with_0504_0000() {
    for (begin, object) in [
        ("40 00 21 04", "00 21 04"),
        ("20 00 22 02", "00 22 02"),
        ("20 00 23 01", "00 23 01"),
        ("C0 00 23 01", "00 23 01"),
        ("A0 00 21 04 7F", "00 21 04"),
    ] {
        let mut board = board();
        board.sdo(begin);
        assert_eq!(board.us_to_deadline(), Some(1_000_000), "{begin}");
        assert_eq!(board.pass_us(999_999), SILENCE);
        let abort = format!("5C0: 80 {object} 00 00 04 05");
        assert_eq!(board.pass_us(1), [abort.as_str()]);
        assert_eq!(board.us_to_deadline(), None);
        assert_eq!(board.node.application().aborted, u32::from(object == "00 23 01"));
        assert_eq!(board.number(0x1018, 4), 0xDEAD_BEEF);
        assert_eq!(board.sdo("60"), ["5C0: 80 00 00 00 01 00 04 05"]);
    }
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
