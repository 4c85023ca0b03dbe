//! The parameters of emergency messages (CiA 301, 7.5.2.17 and 7.5.2.18): COB-ID 1014h and inhibit time 1015h.

use canopen_node::{BusEvent, emergency::Fault};
use testkit::{frames::SILENCE, node_rig::NodeRig, sdo::Client};

use crate::process_data::{DEVICE_STATE, set, write};

const NOT_VALID: u32 = 1 << 31;
const OVERRUN: &str = "0C0: 10 81 11 00 00 00 00 00";
const ERROR_PASSIVE: &str = "0C0: 20 81 11 00 00 00 00 00";
const NO_ERROR: &str = "0C0: 00 00 00 00 00 00 00 00";

#[test]
fn a_cob_id_that_is_not_valid_ends_the_messages_but_not_the_errors() {
    let mut board = NodeRig::with_node_id(0x40);
    set(&mut board, 0x1014, 0, NOT_VALID | 0xC0, 4);
    assert_eq!(board.see(BusEvent::Overrun), SILENCE);
    board.node.handle_fault(Fault::ErrorPassive);
    assert_eq!(board.pass_ms(1000), SILENCE);
    assert_eq!((board.number(0x1001, 0), board.number(0x1003, 0)), (0x11, 2));
    set(&mut board, 0x1014, 0, 0xC0, 4);
    assert_eq!(board.pass_ms(1000), SILENCE, "the past is not reported");
    assert_eq!(board.see(BusEvent::Overrun), [OVERRUN]);
}

#[test]
fn a_master_can_move_the_messages_and_back() {
    let mut board = NodeRig::with_node_id(0x40);
    set(&mut board, 0x1014, 0, NOT_VALID | 0x333, 4);
    set(&mut board, 0x1014, 0, 0x333, 4);
    assert_eq!(board.number(0x1014, 0), 0x333);
    let moved = ["333: 10 81 11 00 00 00 00 00", "333: 00 00 00 00 00 00 00 00"];
    assert_eq!(board.see(BusEvent::Overrun), moved);
    set(&mut board, 0x1014, 0, NOT_VALID | 0xC0, 4);
    set(&mut board, 0x1014, 0, 0xC0, 4);
    assert_eq!(board.see(BusEvent::Overrun), [OVERRUN, NO_ERROR]);
}

#[test]
fn a_valid_cob_id_does_not_change() {
    let mut board = NodeRig::with_node_id(0x40);
    set(&mut board, 0x1014, 0, 0xC0, 4);
    for value in [0xC1, 0x333, 0x80] {
        assert_eq!(write(&mut board, 0x1014, 0, value, 4), Err(DEVICE_STATE), "{value:X}");
    }
    assert_eq!(board.number(0x1014, 0), 0xC0);
}

#[test]
fn after_a_message_the_next_one_waits_for_the_inhibit_time() {
    let mut board = NodeRig::with_node_id(0x40);
    set(&mut board, 0x1015, 0, 100, 2);
    assert_eq!(board.number(0x1015, 0), 100);
    assert_eq!(board.see(BusEvent::Overrun), [OVERRUN]);
    board.node.handle_fault(Fault::ErrorPassive);
    assert_eq!(board.pass_us(9_999), SILENCE);
    assert_eq!(board.pass_us(1), [ERROR_PASSIVE]);
    assert_eq!(board.pass_ms(1000), SILENCE);
    let counters = |receive| BusEvent::ErrorCounters { transmit: 0, receive };
    assert_eq!(board.see(counters(0)), [NO_ERROR], "the time is over");
    set(&mut board, 0x1015, 0, 0, 2);
    assert_eq!(board.see(BusEvent::Overrun), [OVERRUN, NO_ERROR]);
}

#[test]
fn the_inhibit_time_goes_on_in_nmt_stopped() {
    let mut board = NodeRig::with_node_id(0x40);
    set(&mut board, 0x1015, 0, 100, 2);
    assert_eq!(board.see(BusEvent::Overrun), [OVERRUN]);
    board.nmt("02 40");
    assert_eq!(board.pass_ms(1000), SILENCE);
    assert_eq!(board.nmt("80 40"), [NO_ERROR]);
}

#[test]
fn both_parameters_are_stored_and_restored() {
    let parameters = |board: &mut NodeRig| (board.number(0x1014, 0), board.number(0x1015, 0));
    for sub_index in [1, 2] {
        let mut board = NodeRig::with_node_id(0x40);
        set(&mut board, 0x1014, 0, NOT_VALID | 0x333, 4);
        set(&mut board, 0x1015, 0, 0x1234, 2);
        board.nmt("82 40");
        assert_eq!(parameters(&mut board), (0xC0, 0), "not stored");
        set(&mut board, 0x1014, 0, NOT_VALID | 0x333, 4);
        set(&mut board, 0x1015, 0, 0x1234, 2);
        assert_eq!(board.save(3), Ok(()), "the application's");
        board.power_cycle();
        assert_eq!(parameters(&mut board), (0xC0, 0));
        set(&mut board, 0x1014, 0, NOT_VALID | 0x333, 4);
        set(&mut board, 0x1015, 0, 0x1234, 2);
        assert_eq!(board.save(sub_index), Ok(()));
        for restart in ["82 40", "81 40"] {
            board.nmt(restart);
            assert_eq!(parameters(&mut board), (NOT_VALID | 0x333, 0x1234));
        }
        board.configure("11 05, 13 00 00, 17");
        board.power_cycle();
        assert_eq!(parameters(&mut board), (NOT_VALID | 0x333, 0x1234), "LSS keeps them");
        assert_eq!(board.load(sub_index), Ok(()));
        assert_eq!(parameters(&mut board), (NOT_VALID | 0x333, 0x1234), "until a reset");
        board.nmt("82 00");
        assert_eq!(parameters(&mut board), (0x85, 0));
    }
}

#[test]
fn a_stored_cob_id_at_its_default_follows_the_node_id() {
    let mut board = NodeRig::with_node_id(0x40);
    set(&mut board, 0x1014, 0, NOT_VALID | 0xC0, 4);
    assert_eq!(board.save(1), Ok(()));
    board.configure("11 05, 17");
    board.power_cycle();
    assert_eq!(board.number(0x1014, 0), NOT_VALID | 0x85);
}
