//! SDO block transfer (CiA 301, 7.2.4.3.9 to 7.2.4.3.15).

use canopen_node::{
    Application, BusEvent, Instant, Service,
    application::{Domain, Text},
    objects,
    sdo::Abort,
};
use testkit::{
    frames::SILENCE,
    node_rig::NodeRig,
    sdo::{Client, request},
};

use crate::sdo_machine::{Machine, board, board_with_memory, bytes};

/// The text of segment `number` of a block, which begins at byte `start` of `data`.
fn segment(number: u8, data: &[u8], start: usize) -> String {
    let part = &data[start..data.len().min(start + 7)];
    let last = if start + 7 >= data.len() { 0x80 } else { 0 };
    let bytes: String =
        (0..7).map(|at| format!(" {:02X}", part.get(at).copied().unwrap_or(0))).collect();
    format!("{:02X}{bytes}", number | last)
}

/// Sends segments `numbers` of the block that begins at byte `start`; the last one may be answered.
fn send(board: &mut NodeRig<Machine>, numbers: &[u8], data: &[u8], start: usize) -> String {
    let mut answer = String::new();
    for &number in numbers {
        assert_eq!(answer, "", "no answer before the end of the block");
        let at = start + 7 * usize::from(number - 1);
        let answers = board.sdo(&segment(number, data, at));
        answer = answers.0.first().map(testkit::frames::text).unwrap_or_default();
    }
    answer
}

#[test]
fn a_node_whose_values_are_short_has_segmented_transfer_and_refuses_blocks() {
    const COMMAND: u32 = Abort::Command as u32;
    let mut board = NodeRig::with_node_id(0x40);
    assert_eq!(board.upload(0x1008, 0).unwrap(), b"Test board");
    assert_eq!(board.block_upload(0x1008, 0, 1), Err(COMMAND));
    assert_eq!(board.block_upload(0x1018, 4, 1), Err(COMMAND));
    assert_eq!(board.block_download(0x1017, 0, &[0xE8, 3]), Err(COMMAND));
    assert_eq!(board.download_segments(0x1017, 0, &[0xD0, 7], None), Ok(()));
    assert_eq!(board.number(0x1017, 0), 2000);
}

#[test]
fn block_transfer_of_all_objects_is_there_where_one_may_have_more_than_32_bytes() {
    macro_rules! check {
        ($type:ty = $default:expr, $access:ident, $expected:expr) => {{
            objects! {
                struct One, values Value;
                0x2001 { 0 "Value" value: $type = $default, $access; }
            }
            impl Application for One {}

            let mut board = NodeRig::running(One::new());
            let is_read = board.block_upload(0x1018, 4, 1).is_ok();
            let is_written = board.block_download(0x1017, 0, &[0xE8, 3]).is_ok();
            assert_eq!([is_read, is_written], $expected);
        }};
    }

    check!(Text<32> = Text::EMPTY, rw, [false, false]);
    check!(Text<33> = Text::EMPTY, rw, [true, true]);
    check!(&'static str = "", constant, [true, false]);
    check!(Domain = Domain, ro, [true, false]);
    check!(Domain = Domain, wo, [false, true]);
    check!(Domain = Domain, rw, [true, true]);
}

#[test]
fn a_block_is_confirmed_once_however_long_its_client_pauses() {
    for (pause, after) in [(0, 1), (749, 31), (751, 31), (990, 31), (999, 1)] {
        let data = bytes(2_000);
        let mut board = board();
        board.sdo("C0 00 23 01");
        let mut rest = &data[..];
        while !rest.is_empty() {
            let start = data.len() - rest.len();
            let count = rest.len().div_ceil(7).min(127) as u8;
            let (before, behind) = (1..=count).partition::<Vec<_>, _>(|&number| number <= after);
            assert_eq!(send(&mut board, &before, &data, start), "");
            assert_eq!(board.pass_ms(pause), SILENCE, "the block is not complete");
            let confirmation = format!("5C0: A2 {count:02X} 7F 00 00 00 00 00");
            assert_eq!(send(&mut board, &behind, &data, start), confirmation);
            rest = &rest[rest.len().min(7 * usize::from(count))..];
        }
        assert_eq!(board.sdo("C9"), ["5C0: A1 00 00 00 00 00 00 00"]);
        assert!(board.node.application().memory == data, "{pause} ms after segment {after}");
    }
}

type Board = NodeRig<Machine>;
type End = (&'static str, fn(&mut Board));

/// What can end a block download within a block, around its segment 42.
const ENDS: [End; 9] = [
    ("abort by the client", |board| {
        assert_eq!(board.sdo("2A"), SILENCE);
        assert_eq!(board.sdo("80 00 23 01"), SILENCE);
    }),
    ("abort by the server", |board| {
        assert_eq!(board.sdo("2A"), SILENCE);
        assert_eq!(board.sdo("00"), ["5C0: 80 00 23 01 03 00 04 05"]);
    }),
    ("error of the application", |board| {
        board.node.application_mut().refuse_part = Some(Abort::Hardware);
        assert_eq!(board.sdo("2A"), ["5C0: 80 00 23 01 00 00 06 06"]);
        board.node.application_mut().refuse_part = None;
    }),
    ("time-out", |board| {
        assert_eq!(board.sdo("2A"), SILENCE);
        assert_eq!(board.pass_ms(1_000), ["5C0: 80 00 23 01 00 00 04 05"]);
        assert_eq!(board.pass_ms(5_000), SILENCE);
    }),
    ("NMT reset communication", |board| {
        assert_eq!(board.sdo("2A"), SILENCE);
        assert_eq!(board.nmt("82 40"), ["740: 00"]);
    }),
    ("NMT reset communication while a segment waits", |board| {
        let segment = request(0x40, "2A");
        assert_eq!(board.node.handle_frame(&segment, Instant::from_micros(0)), None);
        assert_eq!(board.nmt("82 40"), ["740: 00"]);
    }),
    ("NMT stop while a segment waits", |board| {
        let segment = request(0x40, "2A");
        assert_eq!(board.node.handle_frame(&segment, Instant::from_micros(0)), None);
        board.nmt("02 40");
        board.nmt("80 40");
    }),
    ("NMT stop", |board| {
        board.nmt("02 40");
        assert_eq!(board.sdo("2A"), SILENCE);
        board.nmt("80 40");
    }),
    ("switch of the bit rate", |board| {
        assert_eq!(board.sdo("2A"), SILENCE);
        board.configure("13 00 02, 15 0A 00");
        board.pass_ms(20);
    }),
];

/// A board on which this has ended a block download after 42 segments.
fn board_after(end: impl Fn(&mut Board)) -> Board {
    let mut board = board();
    board.sdo("C0 00 23 01");
    assert_eq!(send(&mut board, &(1..=41).collect::<Vec<_>>(), &bytes(2_000), 0), "");
    end(&mut board);
    assert_eq!(board.node.application().aborted, 1);
    board
}

#[test]
fn the_rest_of_a_block_whose_transfer_has_ended_is_not_executed() {
    for (name, end) in ENDS {
        if matches!(name, "abort by the client" | "time-out") {
            continue;
        }
        for lost in [0, 1, 5] {
            // To the end of the block, to the last segment of all, to silence, and to an abort.
            for (rest, end_ms) in [
                ((43 + lost..=127).collect::<Vec<_>>(), 0),
                (vec![43 + lost, 0xAF], 0),
                (vec![43 + lost], 100),
                (vec![43 + lost, 0x80], 0),
            ] {
                let mut board = board_after(end);
                for number in rest {
                    assert_eq!(board.pass_ms(70), SILENCE, "{name}, {number}");
                    let segment = format!("{number:02X} 17 10 00 39 30");
                    assert_eq!(board.sdo(&segment), SILENCE, "{name}, {number}");
                }
                board.pass_ms(end_ms);
                assert_eq!(board.number(0x1017, 0), 0, "{name}");
                let request = board.sdo("2B 17 10 00 39 30");
                assert_eq!(request, ["5C0: 60 17 10 00 00 00 00 00"], "{name}");
            }
        }
    }
}

#[test]
fn a_client_that_has_ended_a_block_or_been_silent_begins_another_transfer_at_once() {
    for (name, end) in ENDS {
        let end = |board: &mut Board| {
            end(board);
            if !matches!(name, "abort by the client" | "time-out") {
                board.pass_ms(100);
            }
        };
        for request in ["40 18 10 04", "2F 00 21 01 09", "21 00 22 02 03", "A4 08 10 00 7F"] {
            let mut board = board_after(end);
            let [answer] = &board.sdo(request).0[..] else { panic!("{name}, {request}") };
            assert_ne!(answer.data()[0], 0x80, "{name}, {request}");
        }
        let mut board = board_after(end);
        assert_eq!(board.block_download(0x2300, 1, &bytes(2_000)), Ok(()), "{name}");
        assert_eq!(board.node.application().memory, bytes(2_000));
    }
}

#[test]
fn an_abort_ends_a_block_upload_at_once() {
    let mut board = board_with_memory(10_000);
    board.is_acknowledged = false;
    board.sdo("A4 00 23 01 7F");
    assert_eq!(board.sdo("A3").0.len(), 1);
    assert_eq!(board.sdo("80 00 23 01"), SILENCE);
    assert_eq!(board.see(BusEvent::NonePending), SILENCE);
}

#[test]
fn a_segment_is_made_when_no_frame_of_the_node_waits() {
    let mut board = board_with_memory(10_000);
    board.is_acknowledged = false;
    board.sdo("A4 00 23 01 7F");
    assert_eq!(board.sdo("A3").0.len(), 1);
    assert_eq!(board.pass_ms(100), SILENCE);
    assert_eq!(board.acknowledge(Service::Heartbeat), SILENCE, "it is another frame's");
    for _ in 1..127 {
        assert!(board.node.wants_to_send_more());
        assert_eq!(board.see(BusEvent::NonePending).0.len(), 1);
    }
    assert!(!board.node.wants_to_send_more());
    assert_eq!(board.see(BusEvent::NonePending), SILENCE, "until the client confirms");
    assert_eq!(board.lss("04 01"), SILENCE);
    assert_eq!(board.lss("5E"), ["5E 40"]);
}

#[test]
fn a_client_that_misses_a_segment_may_say_so_before_the_end_of_the_block() {
    let mut board = board_with_memory(100);
    board.is_acknowledged = false;
    board.sdo("A0 00 23 01 7F");
    assert_eq!(board.sdo("A3"), ["5C0: 01 01 08 0F 16 1D 24 2B"]);
    board.see(BusEvent::NonePending);
    assert_eq!(board.sdo("A2 01 7F"), ["5C0: 01 32 39 40 47 4E 55 5C"], "the second one again");
}

#[test]
fn a_bus_that_is_blocked_for_a_second_ends_a_block_upload() {
    let mut board = board_with_memory(10_000);
    board.is_acknowledged = false;
    board.sdo("A4 00 23 01 7F");
    board.sdo("A3");
    assert_eq!(board.pass_us(999_999), SILENCE);
    assert_eq!(board.pass_us(1), ["5C0: 80 00 23 01 00 00 04 05"]);
}

#[test]
fn lss_and_heartbeats_are_served_within_a_block_upload() {
    let mut board = board_with_memory(10_000);
    board.download(0x1017, 0, &[10, 0]).unwrap();
    board.is_acknowledged = false;
    board.sdo("A4 00 23 01 7F");
    board.sdo("A3");
    assert_eq!(board.pass_ms(10), ["740: 7F"]);
    assert_eq!(board.configure("5A"), ["5A 44 33 22 11"]);
    assert_eq!(board.see(BusEvent::NonePending).0.len(), 1);
}
