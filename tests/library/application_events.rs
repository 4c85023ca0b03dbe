//! Events of the node for its application, and errors of the application as emergency messages (CiA 301, 7.2.7).

use canopen_node::{
    BitRate, BusEvent,
    application::Event,
    emergency::{Fault, OwnCode, Restart, RestartCause},
    nmt::State,
};
use testkit::{
    frames::{Frames, SILENCE},
    sdo::Client,
};

use crate::process_data::{Board, board, receive, set, take_events};

const NO_ERROR: &str = "0C0: 00 00 00 00 00 00 00 00";

fn report(board: &mut Board, code: u16, register: u8, information: [u8; 5]) -> Frames {
    board.node.report(code, register, information);
    board.pass_us(0)
}

fn end(board: &mut Board, code: u16) -> Frames {
    board.node.end_report(code);
    board.pass_us(0)
}

#[test]
fn the_application_is_informed_of_each_nmt_state() {
    let mut board = board();
    board.nmt("01 40");
    board.nmt("02 40");
    board.nmt("80 40");
    board.nmt("80 40");
    board.nmt("82 40");
    board.nmt("81 40");
    let nmt = |state| Event::Nmt(state);
    assert_eq!(
        take_events(),
        [
            nmt(State::Operational),
            nmt(State::Stopped),
            nmt(State::PreOperational),
            nmt(State::Initialisation),
            nmt(State::PreOperational),
            nmt(State::PreOperational),
        ],
        "the last one after the restart"
    );
}

#[test]
fn the_application_is_informed_of_each_bit_rate() {
    let mut board = board();
    board.configure("13 00 02, 15 0A");
    board.pass_ms(20);
    assert_eq!(take_events(), [Event::BitRate(BitRate::Kbit500)]);
}

#[test]
fn an_error_of_the_application_is_an_emergency_message() {
    let mut board = board();
    let frames = report(&mut board, 0x4310, 0x08, [1, 2, 3, 4, 5]);
    assert_eq!(frames, ["0C0: 10 43 09 01 02 03 04 05"]);
    assert_eq!((board.number(0x1001, 0), board.number(0x1003, 1)), (0x09, 0x0201_4310));
    assert_eq!(board.pass_ms(10_000), SILENCE);
    assert_eq!(end(&mut board, 0x4311), SILENCE, "not this one");
    assert_eq!(end(&mut board, 0x4310), [NO_ERROR]);
    assert_eq!(end(&mut board, 0x4310), SILENCE);
    assert_eq!(board.number(0x1001, 0), 0);
}

#[test]
fn error_code_0_follows_the_last_error_of_node_and_application() {
    let mut board = board();
    report(&mut board, 0x4310, 0x08, [0; 5]);
    report(&mut board, 0xFF80, 0x80, [0; 5]);
    let passive = BusEvent::ErrorCounters { transmit: 128, receive: 0 };
    assert_eq!(board.see(passive), ["0C0: 20 81 99 00 00 00 00 00"]);
    assert_eq!(end(&mut board, 0x4310), SILENCE);
    assert_eq!(board.number(0x1001, 0), 0x91);
    assert_eq!(board.see(BusEvent::ErrorCounters { transmit: 0, receive: 0 }), SILENCE);
    assert_eq!(end(&mut board, 0xFF80), [NO_ERROR]);
}

#[test]
fn eight_errors_at_once_are_sent_in_their_order_and_a_ninth_finds_no_room() {
    let mut board = board();
    for code in 0x5001..=0x5008 {
        assert!(board.node.report(code, 0, [0; 5]));
    }
    assert!(!board.node.report(0x5009, 0x80, [0; 5]));
    let frames = board.pass_us(0);
    let codes: Vec<_> = frames.0.iter().map(|frame| frame.data()[0]).collect();
    assert_eq!(codes, [1, 2, 3, 4, 5, 6, 7, 8]);
    assert!(!board.node.report(0x5009, 0x80, [0; 5]));
    assert!(board.node.report(0x5008, 0, [0; 5]), "it has its place");
    assert_eq!(board.pass_us(0).0.len(), 1);
    assert_eq!((board.number(0x1003, 1), board.number(0x1001, 0)), (0x5008, 1));
    for code in 0x5001..=0x5007 {
        assert_eq!(end(&mut board, code), SILENCE);
    }
    assert_eq!(end(&mut board, 0x5008), [NO_ERROR]);
}

#[test]
fn eight_errors_of_the_application_leave_room_for_each_of_the_node() {
    let mut board = board();
    set(&mut board, 0x1016, 1, 0x0005_0064, 4);
    set(&mut board, 0x1029, 1, 1, 1);
    set(&mut board, 0x1400, 5, 100, 2);
    board.nmt("01 40");
    for code in 0x5001..=0x5008 {
        assert!(board.node.report(code, 0, [0; 5]));
    }
    assert_eq!(board.pass_us(0).0.len(), 8);
    assert_eq!(receive(&mut board, "705: 05"), SILENCE);
    assert_eq!(board.pass_ms(100), ["0C0: 30 81 11 05 00 00 00 00"], "heartbeat lost");
    assert_eq!(board.number(0x1001, 0), 0x11);
    assert_eq!(receive(&mut board, "240: 01"), ["0C0: 10 82 11 01 00 00 00 00"], "too short");
    assert_eq!(receive(&mut board, "340: 01"), ["0C0: 10 82 11 02 00 00 00 00"]);
    assert_eq!(receive(&mut board, "240: 1 2 3 4"), ["0C0: 20 82 11 01 00 00 00 00"], "too long");
    assert_eq!(receive(&mut board, "080: 01"), ["0C0: 40 82 11 01 00 00 00 00"], "SYNC");
    assert_eq!(board.pass_ms(100), ["0C0: 50 82 11 01 00 00 00 00"], "late");
    assert_eq!(board.see(BusEvent::Overrun), ["0C0: 10 81 11 00 00 00 00 00"]);
    for frame in ["705: 05", "240: 0 0 0", "340: 0 0 0 0 0 0", "080:"] {
        receive(&mut board, frame);
    }
    assert_eq!(board.number(0x1001, 0), 0x01, "those of the node are over");
    for code in 0x5001..=0x5007 {
        assert_eq!(end(&mut board, code), SILENCE);
    }
    assert_eq!(end(&mut board, 0x5008), [NO_ERROR]);
}

#[test]
fn an_error_that_ends_before_its_message_leaves_is_reported_and_ended() {
    let mut board = board();
    board.node.report(0x4310, 0, [0; 5]);
    board.node.end_report(0x4310);
    assert_eq!(board.pass_us(0), ["0C0: 10 43 01 00 00 00 00 00", NO_ERROR]);
}

#[test]
fn an_error_that_has_ended_makes_room_for_another() {
    let mut board = board();
    for code in 0x5001..=0x5020 {
        assert_eq!(report(&mut board, code, 0, [0; 5]).0[0].data()[0], code as u8);
        assert_eq!(end(&mut board, code), [NO_ERROR]);
    }
}

#[test]
fn bit_0_of_the_error_register_is_set_with_each_error_of_the_application() {
    for register in [0x00, 0x01, 0x80, 0x81] {
        let expected = format!("0C0: 10 43 {:02X} 00 00 00 00 00", register | 1);
        assert_eq!(report(&mut board(), 0x4310, register, [0; 5]), [&*expected]);
    }
}

#[test]
fn the_application_cannot_report_an_error_of_the_node_or_none() {
    let mut board = board();
    for code in OwnCode::ALL.map(|own| own.code).into_iter().chain([0]) {
        assert!(!board.node.report(code, 0x08, [0; 5]), "{code:04X}h");
        assert_eq!(board.pass_us(0), SILENCE);
    }
    assert_eq!(board.number(0x1001, 0), 0);
    assert!(board.node.report(0xFF01, 0x08, [0; 5]));
}

#[test]
fn each_message_of_the_node_is_that_of_its_row() {
    let restarted = |cause| Fault::Restarted(Restart { cause, address: 0 });
    let away = Fault::AwayFromHomeRate { in_use: BitRate::Kbit125, home: BitRate::Kbit500 };
    for (code, fault) in [
        (0x5000, restarted(RestartCause::NoCrystal)),
        (0x6100, restarted(RestartCause::Panic)),
        (0x6310, Fault::SettingsLost),
        (0x8110, Fault::Overrun),
        (0x8120, Fault::ErrorPassive),
        (0x8140, Fault::BusOffRecovered),
        (0xFF10, away),
    ] {
        let mut board = board();
        board.node.handle_fault(fault);
        let sent = board.pass_us(0);
        let [low, high, register, ..] = sent.0[0].data() else { panic!("{sent:?}") };
        let row = OwnCode::ALL.into_iter().find(|own| own.code == code).expect("a row");
        assert_eq!((u16::from_le_bytes([*low, *high]), *register), (code, row.register));
    }
}
