//! Object 2FF0h, by which a master without LSS sets node-ID and bit rate: pending, active and persistent as those of LSS
//! are (CiA 305).

use canopen_node::{Application, BitRate, BitRates, Device, objects};
use testkit::{
    flash::{BoardFlash, Operation},
    frames::SILENCE,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::Client,
};

use crate::process_data::{DEVICE_STATE, INVALID_VALUE, set, write};

const NO_OBJECT: u32 = 0x0602_0000;
const INDEX: u16 = 0x2FF0;

objects! {
    /// A device with objects on both sides of 2FF0h.
    struct Sensor, values SensorValue;

    0x2FEF {
        0 "Gain" gain: u8 = 1, rw, stored;
    }
    0x2FF1 {
        0 "Offset" offset: u8 = 2, rw, stored;
    }
}

impl Application for Sensor {
    const SETTINGS_BY_SDO: bool = true;
}

type Board = NodeRig<Sensor>;

fn board_of(device: Device) -> Board {
    NodeRig::with_application(device, BoardFlash::blank(0), 0, Sensor::new())
}

fn board() -> Board {
    board_of(device(ADDRESS).with_defaults(defaults(0x40)))
}

/// Pending node-ID and bit rate, as the object has them.
fn pending(board: &mut Board) -> (u32, u32) {
    (board.number(INDEX, 1), board.number(INDEX, 2))
}

#[test]
fn the_object_is_off_by_default_and_hides_none_of_the_application() {
    assert_eq!(NodeRig::with_node_id(0x40).upload(INDEX, 1), Err(NO_OBJECT));
    let mut board = board();
    assert_eq!([0, 1, 2].map(|sub| board.number(INDEX, sub)), [2, 0x40, 1000]);
    assert_eq!((board.number(0x2FEF, 0), board.number(0x2FF1, 0)), (1, 2));
}

#[test]
fn a_node_id_is_pending_until_reset_communication_and_stored_by_1010() {
    let mut board = board();
    set(&mut board, INDEX, 1, 5, 1);
    assert_eq!(pending(&mut board), (5, 1000));
    assert_eq!(board.configure("5E, 04 00"), ["5E 40"], "it is not active");
    assert_eq!(board.nmt("82 00"), ["705: 00"]);
    board.power_cycle();
    assert_eq!(pending(&mut board), (0x40, 1000), "it was not stored");
    for sub_index in [1, 3] {
        set(&mut board, INDEX, 1, u32::from(sub_index), 1);
        assert_eq!(board.save(sub_index), Ok(()));
        assert_eq!(board.power_cycle(), [format!("70{sub_index}: 00").as_str()]);
    }
    set(&mut board, INDEX, 1, 7, 1);
    assert_eq!(board.save(2), Ok(()), "the communication part");
    assert_eq!(board.power_cycle(), ["703: 00"]);
}

#[test]
fn a_bit_rate_is_in_use_after_it_was_stored_and_the_device_reset() {
    for restart in [|board: &mut Board| board.power_cycle(), |board: &mut Board| board.nmt("81 00")]
    {
        let mut board = board();
        set(&mut board, INDEX, 2, 250, 2);
        board.nmt("82 40");
        assert_eq!(board.bit_rate(), BitRate::Kbit1000, "reset communication leaves it");
        assert_eq!(pending(&mut board), (0x40, 250));
        restart(&mut board);
        assert_eq!(board.bit_rate(), BitRate::Kbit1000, "it was not stored");
        set(&mut board, INDEX, 2, 250, 2);
        assert_eq!(board.save(1), Ok(()));
        assert_eq!(board.bit_rate(), BitRate::Kbit1000);
        restart(&mut board);
        assert_eq!(board.bit_rate(), BitRate::Kbit250);
    }
}

#[test]
fn what_lss_refuses_is_refused_and_leaves_what_was_pending() {
    let mut board = board_of(
        device(ADDRESS)
            .with_bit_rates(BitRates::possible(42_000_000))
            .with_defaults(defaults(0x40)),
    );
    set(&mut board, INDEX, 1, 9, 1);
    set(&mut board, INDEX, 2, 500, 2);
    for node_id in (128..255).chain([0]) {
        assert_eq!(write(&mut board, INDEX, 1, node_id, 1), Err(INVALID_VALUE), "{node_id}");
    }
    for kbit_per_s in [0, 1, 100, 800, 999, 65_535] {
        assert_eq!(write(&mut board, INDEX, 2, kbit_per_s, 2), Err(INVALID_VALUE), "{kbit_per_s}");
    }
    assert_eq!(pending(&mut board), (9, 500));
    for kbit_per_s in [1000, 500, 250, 125, 50, 20, 10] {
        set(&mut board, INDEX, 2, kbit_per_s, 2);
        assert_eq!(pending(&mut board), (9, kbit_per_s));
    }
}

#[test]
fn ff_takes_the_node_id_away_and_0_asks_for_detection() {
    let mut board = board_of(
        device(ADDRESS)
            .with_bit_rates(BitRates::possible(40_000_000).with_automatic())
            .with_defaults(defaults(0x40)),
    );
    set(&mut board, INDEX, 1, 0xFF, 1);
    set(&mut board, INDEX, 2, 0, 2);
    assert_eq!(pending(&mut board), (0xFF, 0));
    assert_eq!(board.save(1), Ok(()));
    assert_eq!(board.power_cycle(), SILENCE);
    assert_eq!((board.node.node_id(), board.node.is_listening()), (None, true));
}

#[test]
fn lss_and_the_object_have_the_same_pending_values() {
    let mut board = board();
    board.configure("11 06, 13 00 02, 04 00");
    assert_eq!(pending(&mut board), (6, 500));
    set(&mut board, INDEX, 1, 7, 1);
    set(&mut board, INDEX, 2, 125, 2);
    board.configure("17, 15 00 00, 04 00");
    board.pass_ms(1);
    assert_eq!(board.bit_rate(), BitRate::Kbit125, "15 activates it");
    assert_eq!(board.power_cycle(), ["707: 00"], "17 has stored it");
    assert_eq!(board.bit_rate(), BitRate::Kbit125);
}

#[test]
fn what_lss_has_configured_is_stored_by_lss_alone() {
    let mut board = board();
    set(&mut board, INDEX, 1, 5, 1);
    set(&mut board, INDEX, 2, 250, 2);
    board.configure("11 06, 13 00 02, 04 00");
    assert_eq!(board.save(1), Ok(()));
    assert_eq!(board.power_cycle(), ["740: 00"]);
    assert_eq!(pending(&mut board), (0x40, 1000));
}

#[test]
fn with_the_lss_lock_nobody_sets_them_in_operational() {
    let mut board = board_of(device(ADDRESS).with_defaults(defaults(0x40)).with_lss_lock(true));
    board.nmt("01 40");
    assert_eq!(write(&mut board, INDEX, 1, 5, 1), Err(DEVICE_STATE));
    assert_eq!(write(&mut board, INDEX, 2, 500, 2), Err(DEVICE_STATE));
    assert_eq!(pending(&mut board), (0x40, 1000));
    board.nmt("80 40");
    set(&mut board, INDEX, 1, 5, 1);
}

#[test]
fn the_defaults_of_1011_and_a_failed_store_leave_what_is_stored() {
    let mut board = board();
    set(&mut board, INDEX, 1, 5, 1);
    assert_eq!(board.save(1), Ok(()));
    assert_eq!(board.load(1), Ok(()));
    assert_eq!(board.power_cycle(), ["705: 00"], "it can still be reached");
    set(&mut board, INDEX, 1, 6, 1);
    board.flash.fail(Operation::Write);
    assert!(board.save(1).is_err());
    board.flash.repair();
    assert_eq!(board.power_cycle(), ["705: 00"]);
}
