//! The LSS lock, an option of the device: in NMT operational the LSS state stays waiting.

use testkit::{
    frames::SILENCE,
    node_rig::{ADDRESS, NodeRig, defaults, device},
};

use crate::lss_states::{IDENTIFY, SELECT};

fn board(lss_lock: bool, node_id: u8) -> NodeRig {
    let device = device(ADDRESS).with_lss_lock(lss_lock);
    NodeRig::of(device.with_defaults(defaults(node_id)))
}

#[test]
fn with_the_lock_no_switch_state_leads_to_configuration_in_operational() {
    let mut board = board(true, 0x40);
    board.nmt("01 40");
    let others = ["04 01", "11 05", "13 00 02", "17", "5A", "5E"];
    for request in SELECT.split(", ").chain(others) {
        assert_eq!(board.lss(request), SILENCE, "{request}");
    }
    assert_eq!(board.stored(), None);
    board.nmt("80 40");
    assert_eq!(board.lss("43 EF BE AD DE"), SILENCE, "the steps do not count any more");
}

#[test]
fn with_the_lock_a_node_in_nmt_operational_is_still_identified() {
    let mut board = board(true, 0x40);
    board.nmt("01 40");
    let (steps, last) = IDENTIFY.rsplit_once(", ").expect("steps");
    for step in steps.split(", ") {
        assert_eq!(board.lss(step), SILENCE);
    }
    assert_eq!(board.lss(last), ["4F"]);
}

#[test]
fn with_the_lock_configuration_ends_in_operational_and_is_free_afterwards() {
    for leave in ["02 40", "80 40"] {
        let mut board = board(true, 0x40);
        assert_eq!(board.configure("11 05"), ["11 00"]);
        board.nmt("01 40");
        assert_eq!(board.lss("5E"), SILENCE);
        board.nmt(leave);
        assert_eq!(board.lss("5E"), SILENCE, "in waiting state");
        assert_eq!(board.configure("5E"), ["5E 40"]);
        assert_eq!(board.lss("17"), ["17 00"], "the pending values still are");
        assert_eq!(board.stored().and_then(|s| s.node_id).map(|id| id.get()), Some(5));
    }
}

#[test]
fn with_the_lock_a_blank_node_is_configured_despite_nmt_commands_to_all() {
    let mut board = board(true, 0xFF);
    board.nmt("01 00");
    board.lss("04 01");
    board.nmt("01 00");
    assert_eq!(board.lss("11 05"), ["11 00"]);
    assert_eq!(board.lss("04 00"), ["705: 00"]);
}
