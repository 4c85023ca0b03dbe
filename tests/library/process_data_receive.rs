//! RPDOs and SYNC (CiA 301, 7.2.2 and 7.2.5): their effect on the application, and the errors that they report.

use canopen_node::{Action, application::Event};
use testkit::{frames::SILENCE, sdo::Client};

use crate::process_data::{
    Board, INVALID_VALUE, board, map, operational, receive, set, take_events, write,
};

const NO_ERROR: &str = "0C0: 00 00 00 00 00 00 00 00";

/// Lamps and speed.
fn outputs(board: &Board) -> (u8, u16) {
    (board.node.application().lamps, board.node.application().speed)
}

#[test]
fn an_rpdo_has_an_effect_in_operational_only() {
    let mut board = board();
    for command in ["80 40", "02 40"] {
        board.nmt(command);
        take_events();
        receive(&mut board, "240: 05 E7 03");
        receive(&mut board, "080:");
        assert_eq!((outputs(&board), take_events()), ((0, 0), vec![]), "nor has a SYNC");
    }
}

#[test]
fn an_rpdo_of_type_0_to_240_takes_effect_at_the_next_sync() {
    for transmission_type in [0, 1, 240] {
        let mut board = operational();
        set(&mut board, 0x1400, 2, transmission_type, 1);
        receive(&mut board, "240: 05 E7 03");
        receive(&mut board, "240: 06 E7 03");
        assert_eq!(outputs(&board), (0, 0), "{transmission_type}");
        receive(&mut board, "080:");
        assert_eq!(outputs(&board), (6, 999));
        assert_eq!(take_events(), [Event::Received(1), Event::Sync]);
        board.node.application_mut().lamps = 0;
        receive(&mut board, "080:");
        assert_eq!(outputs(&board), (0, 999), "once");
    }
}

#[test]
fn a_dummy_entry_leaves_out_its_bytes() {
    let mut board = operational();
    receive(&mut board, "340: FF FF 44 33 22 11");
    receive(&mut board, "080:");
    assert_eq!(board.node.application().command, 0x1122_3344);
}

#[test]
fn a_short_rpdo_is_8210_and_ignored_until_a_right_one_ends_the_error() {
    let mut board = operational();
    let short = ["0C0: 10 82 11 01 00 00 00 00"];
    assert_eq!(receive(&mut board, "240: 05 00"), short);
    assert_eq!((outputs(&board), take_events()), ((0, 0), vec![]));
    assert_eq!(receive(&mut board, "240:"), SILENCE, "once");
    assert_eq!((outputs(&board), board.number(0x1001, 0)), ((0, 0), 0x11));
    assert_eq!(receive(&mut board, "340: 00 00 00 00 00 00"), SILENCE, "another RPDO");
    assert_eq!(receive(&mut board, "240: 05 00 00"), [NO_ERROR]);
    assert_eq!((outputs(&board), board.number(0x1001, 0)), ((5, 0), 0));
    assert_eq!(board.number(0x1003, 1), 0x0001_8210);
    assert_eq!(receive(&mut board, "240: 05 00"), short, "each time");
}

#[test]
fn a_long_rpdo_is_8220_and_its_first_bytes_count() {
    let mut board = operational();
    assert_eq!(receive(&mut board, "240: 05 01 00 FF"), ["0C0: 20 82 11 01 00 00 00 00"]);
    assert_eq!(outputs(&board), (5, 1));
    assert_eq!(receive(&mut board, "240: 06 01"), ["0C0: 10 82 11 01 00 00 00 00"]);
    assert_eq!(receive(&mut board, "240: 06 01 00"), [NO_ERROR]);
}

#[test]
fn an_rpdo_that_is_invalid_or_empty_has_no_effect() {
    let mut board = operational();
    set(&mut board, 0x1400, 1, 0x8000_0240, 4);
    assert_eq!(receive(&mut board, "240: 05 00 00"), SILENCE);
    map(&mut board, 0x1400, 0x240, &[]);
    assert_eq!(receive(&mut board, "240: 05 00 00"), SILENCE);
    assert_eq!((outputs(&board), take_events().len()), ((0, 0), 0));
}

#[test]
fn a_new_cob_id_of_an_rpdo_reaches_the_board() {
    let mut board = board();
    let receives = |board: &Board| board.node.receives().iter().collect::<Vec<_>>();
    assert_eq!(receives(&board), [0x7E5, 0x000, 0x640, 0x080, 0x240, 0x340, 0x7E5, 0x7E5]);
    board.take_actions();
    set(&mut board, 0x1400, 1, 0x8000_0240, 4);
    assert!(board.take_actions().contains(&Action::SetReceives));
    assert_eq!(receives(&board), [0x7E5, 0x000, 0x640, 0x080, 0x7E5, 0x340, 0x7E5, 0x7E5]);
    set(&mut board, 0x1400, 1, 0x323, 4);
    set(&mut board, 0x1005, 0, 0x081, 4);
    set(&mut board, 0x1016, 2, 0x0005_0064, 4);
    assert_eq!(receives(&board), [0x7E5, 0x000, 0x640, 0x081, 0x323, 0x340, 0x7E5, 0x705]);
    assert!(board.node.receives().contains(0x323) && !board.node.receives().contains(0x240));
    board.take_actions();
    set(&mut board, 0x1800, 2, 255, 1);
    assert!(!board.take_actions().contains(&Action::SetReceives));
    board.nmt("01 40");
    receive(&mut board, "323: 05 00 00");
    assert_eq!(outputs(&board), (5, 0));
}

#[test]
fn the_cob_id_of_sync_can_be_moved_but_the_node_is_no_producer() {
    let mut board = operational();
    assert_eq!(board.number(0x1005, 0), 0x80);
    for value in [0x4000_0080, 0x2000_0080, 0x0000_07FF, 0] {
        assert_eq!(write(&mut board, 0x1005, 0, value, 4), Err(INVALID_VALUE), "{value:X}");
    }
    set(&mut board, 0x1005, 0, 0x8000_0100, 4);
    assert_eq!(board.number(0x1005, 0), 0x100, "bit 31 has no meaning");
    assert_eq!(receive(&mut board, "080:"), SILENCE);
    assert_eq!(receive(&mut board, "100:").0.len(), 1);
}

#[test]
fn a_sync_whose_length_does_not_fit_1019_is_8240_and_ignored() {
    let mut board = operational();
    assert_eq!(receive(&mut board, "080: 01"), ["0C0: 40 82 11 01 00 00 00 00"]);
    assert_eq!(receive(&mut board, "080: 02"), SILENCE, "once");
    assert_eq!(receive(&mut board, "080:"), [NO_ERROR, "2C0: 00 00 00 00 00 00 00 00"]);
    for value in [1, 241, 255] {
        assert_eq!(write(&mut board, 0x1019, 0, value, 1), Err(INVALID_VALUE), "{value}");
    }
    set(&mut board, 0x1019, 0, 240, 1);
    assert_eq!(receive(&mut board, "080:"), ["0C0: 40 82 11 00 00 00 00 00"]);
    assert_eq!(receive(&mut board, "080: F0").0.len(), 2);
    set(&mut board, 0x1019, 0, 0, 1);
}
