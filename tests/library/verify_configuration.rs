//! Verify configuration 1020h (CiA 301, 7.5.2.23): date and time that a master stores with a configuration, which end
//! with the next change of it.

use canopen_node::{
    Application, Frame,
    application::Text,
    objects,
    pdo::{Rpdo, Tpdo},
};
use testkit::{flash::Operation, node_rig::NodeRig, sdo::Client};

use crate::process_data::set;

objects! {
    /// A drive with values of which some are stored.
    struct Drive, values DriveValue;

    0x2100 {
        0 "Ramp" ramp: u16 = 100, rw, stored;
    }
    0x2101 {
        0 "Name" name: Text<20> = Text::EMPTY, rw, stored;
    }
    0x2102 {
        0 "Speed" speed: u16 = 0, rw, mappable;
    }
    0x2103 {
        0 "Limit" limit: u16 = 0, rw, mappable, stored;
    }
}

impl Application for Drive {
    const TPDOS: &'static [Tpdo] = &[Tpdo::UNUSED];
    const RPDOS: &'static [Rpdo] = &[Rpdo::new(&[(0x2102, 0), (0x2103, 0)])];
    const PRODUCERS: usize = 1;
}

type Board = NodeRig<Drive>;

const STAMP: (u32, u32) = (0x1234_5678, 0x9ABC_DEF0);
const NONE: (u32, u32) = (0, 0);

fn stamp(board: &mut impl Client) -> (u32, u32) {
    (board.number(0x1020, 1), board.number(0x1020, 2))
}

fn set_stamp(board: &mut impl Client) {
    set(board, 0x1020, 1, STAMP.0, 4);
    set(board, 0x1020, 2, STAMP.1, 4);
}

fn board() -> Board {
    Board::running(Drive::new())
}

/// A board whose configuration a master has stored, with its stamp.
fn configured() -> Board {
    let mut board = board();
    set(&mut board, 0x2100, 0, 200, 2);
    board.download(0x2101, 0, b"conveyor at gate 2").unwrap();
    set_stamp(&mut board);
    assert_eq!(board.save(1), Ok(()));
    board
}

#[test]
fn a_store_of_all_stores_it_and_later_stores_of_a_part_keep_it() {
    let mut board = NodeRig::with_node_id(0x40);
    set_stamp(&mut board);
    for sub_index in [1, 2, 3] {
        assert_eq!(board.save(sub_index), Ok(()));
        for restart in ["82 40", "81 40"] {
            board.nmt(restart);
            assert_eq!(stamp(&mut board), STAMP, "{restart}");
        }
        board.configure("11 40, 13 00 00, 17");
        board.power_cycle();
        assert_eq!(stamp(&mut board), STAMP, "LSS keeps it");
    }
}

#[test]
fn a_store_of_a_part_stores_no_stamp_of_values_that_a_power_cut_takes() {
    for is_configured in [false, true] {
        for (sub_index, left) in [(1, (1000, 300)), (2, (1000, 0)), (3, (0, 300))] {
            let mut board = if is_configured { configured() } else { board() };
            let ramp = board.number(0x2100, 0);
            set(&mut board, 0x1017, 0, 1000, 2);
            set(&mut board, 0x2100, 0, 300, 2);
            set(&mut board, 0x1020, 1, 0x2222_2222, 4);
            assert_eq!(board.save(sub_index), Ok(()));
            assert_eq!(board.number(0x1020, 1), 0x2222_2222, "all of it is in use");
            board.power_cycle();
            let values = (board.number(0x1017, 0), board.number(0x2100, 0));
            let left = (left.0, if left.1 == 0 { ramp } else { left.1 });
            assert_eq!(values, left, "1010h sub {sub_index}");
            let expected = if sub_index == 1 { (0x2222_2222, 0) } else { NONE };
            assert_eq!(stamp(&mut board), expected, "1010h sub {sub_index}");
        }
    }
}

#[test]
fn a_power_cut_in_a_store_of_a_part_leaves_no_stamp_without_its_values() {
    for sub_index in [2, 3] {
        for step in 0.. {
            let mut board = configured();
            set(&mut board, 0x1017, 0, 1000, 2);
            set(&mut board, 0x2100, 0, 300, 2);
            set(&mut board, 0x1020, 1, 0x2222_2222, 4);
            board.flash.cut_power_after(step);
            let is_saved = board.save(sub_index).is_ok();
            let is_over = board.flash.is_powered();
            board.flash.power_on();
            board.power_cycle();
            let values = (board.number(0x1017, 0), board.number(0x2100, 0));
            let expected = if values == (0, 200) { STAMP } else { NONE };
            assert_eq!(stamp(&mut board), expected, "step {step}: {values:?}");
            assert!(values != (0, 200) || !is_saved, "step {step}");
            if is_over {
                break;
            }
        }
    }
}

#[test]
fn a_change_of_any_stored_parameter_ends_it() {
    let long_name: &[u8] = b"conveyor at gate 3";
    let changes: [(u16, u8, &[u8]); 17] = [
        (0x1005, 0, &[0x81, 0, 0, 0]),
        (0x1006, 0, &[1, 0, 0, 0]),
        (0x1007, 0, &[1, 0, 0, 0]),
        (0x1014, 0, &[0xC0, 0, 0, 0x80]),
        (0x1015, 0, &[1, 0]),
        (0x1016, 1, &[0xE8, 3, 5, 0]),
        (0x1017, 0, &[0xE8, 3]),
        (0x1019, 0, &[10]),
        (0x1029, 1, &[1]),
        (0x1400, 1, &[0x40, 2, 0, 0x80]),
        (0x1400, 2, &[1]),
        (0x1400, 5, &[1, 0]),
        (0x1800, 5, &[1, 0]),
        (0x2100, 0, &[201, 0]),
        (0x2101, 0, long_name),
        (0x2101, 0, b"conveyor"),
        (0x2103, 0, &[1, 0]),
    ];
    for (index, sub_index, value) in changes {
        let mut board = configured();
        board.download(index, sub_index, value).unwrap();
        assert_eq!(stamp(&mut board), NONE, "{index:04X} sub {sub_index}");
        board.power_cycle();
        assert_eq!(stamp(&mut board), STAMP, "the stored configuration has not changed");
        board.download(index, sub_index, value).unwrap();
        let area = if index < 0x2000 { 2 } else { 3 };
        assert_eq!(board.save(area), Ok(()));
        board.power_cycle();
        assert_eq!(stamp(&mut board), NONE, "{index:04X} sub {sub_index} is stored");
    }
}

#[test]
fn the_same_value_a_refused_one_and_a_value_that_is_not_stored_leave_it() {
    let mut board = configured();
    set(&mut board, 0x1005, 0, 0x80, 4);
    set(&mut board, 0x1014, 0, 0xC0, 4);
    set(&mut board, 0x1017, 0, 0, 2);
    set(&mut board, 0x1400, 1, 0x240, 4);
    set(&mut board, 0x1029, 1, 0, 1);
    set(&mut board, 0x2100, 0, 200, 2);
    board.download(0x2101, 0, b"conveyor at gate 2").unwrap();
    set(&mut board, 0x2102, 0, 5, 2);
    set(&mut board, 0x1003, 0, 0, 1);
    assert!(board.download(0x1029, 1, &[3]).is_err());
    assert!(board.download(0x2100, 0, &[3]).is_err());
    board.nmt("01 40");
    board.receive(&Frame::new(0x240, &[1, 0, 2, 0]).expect("a frame"));
    assert_eq!(board.number(0x2103, 0), 2);
    assert_eq!(stamp(&mut board), STAMP, "nor does process data end it");
}

#[test]
fn reset_communication_leaves_only_a_stored_one() {
    let mut board = board();
    set_stamp(&mut board);
    board.nmt("82 40");
    assert_eq!(stamp(&mut board), NONE);
    let mut board = configured();
    set(&mut board, 0x2100, 0, 1, 2);
    board.nmt("82 40");
    assert_eq!(stamp(&mut board), NONE, "the ramp is still changed");
    assert_eq!(board.number(0x2100, 0), 1);
    board.nmt("81 40");
    assert_eq!(stamp(&mut board), STAMP);
    assert_eq!(board.number(0x2100, 0), 200);
}

#[test]
fn each_sub_index_of_1011_ends_it() {
    for sub_index in [1, 2, 3] {
        let mut board = configured();
        assert_eq!(board.load(sub_index), Ok(()));
        assert_eq!(stamp(&mut board), NONE);
        board.power_cycle();
        assert_eq!(stamp(&mut board), NONE);
    }
}

#[test]
fn a_store_that_fails_leaves_the_stored_one() {
    let mut board = configured();
    set(&mut board, 0x1020, 2, 7, 4);
    board.flash.fail(Operation::Write);
    assert!(board.save(1).is_err());
    assert!(board.load(1).is_err());
    board.flash.repair();
    board.power_cycle();
    assert_eq!(stamp(&mut board), STAMP);
}

#[test]
fn a_store_takes_it_as_it_is_when_the_store_begins() {
    let mut board = configured();
    board.let_stores_take_time();
    board.sdo("23 10 10 01 73 61 76 65");
    set(&mut board, 0x1015, 0, 7, 2);
    board.finish_store();
    assert_eq!(stamp(&mut board), NONE);
    board.power_cycle();
    assert_eq!(stamp(&mut board), STAMP);
    assert_eq!(board.number(0x1015, 0), 0);
}
