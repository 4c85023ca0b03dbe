//! The node-ID, persistent, pending and active: the events that move it (CiA 305, configure node-ID).

use canopen_node::{NodeId, Settings, lss::StoreError, nmt::State};
use testkit::{
    flash::{BoardFlash, Operation},
    frames::SILENCE,
    node_rig::{ADDRESS, NodeRig, defaults},
};

/// The pending node-ID, determined by NMT reset communication.
fn pending(board: &mut NodeRig) -> Option<u8> {
    board.nmt("82 00");
    board.lss("04 01");
    board.inquired_node_id()
}

/// The stored node-ID, as LSS encodes it.
fn stored(board: &NodeRig) -> Option<u8> {
    board.stored().map(|settings| NodeId::to_lss(settings.node_id))
}

#[test]
fn configure_node_id_takes_01_to_7f_and_ff_and_refuses_the_rest() {
    for byte in 0..=0xFF {
        let mut board = NodeRig::with_node_id(0x40);
        board.configure("11 05");
        let is_valid = matches!(byte, 0x01..=0x7F | 0xFF);
        let answers = board.lss(&format!("11 {byte:02X}"));
        assert_eq!(answers, if is_valid { ["11 00"] } else { ["11 01"] }, "{byte:02X}");
        assert_eq!(pending(&mut board), Some(if is_valid { byte } else { 0x05 }));
    }
}

#[test]
fn configure_node_id_changes_nothing_but_the_pending_node_id() {
    for id in ["05", "FF"] {
        let mut board = NodeRig::with_heartbeat(0x40, 100);
        board.nmt("01 00");
        board.lss("04 01");
        board.timeline();
        assert_eq!(board.lss(&format!("11 {id}")), ["11 00"]);
        assert_eq!(board.timeline(), ["0 ms 7E4: 11 00 00 00 00 00 00 00"]);
        assert_eq!(board.lss("5E"), ["5E 40"]);
        assert_eq!(board.pass_ms(100), ["740: 05"]);
        assert_eq!(stored(&board), None);
    }
}

#[test]
fn power_on_with_nothing_usable_stored_brings_the_default_of_the_device() {
    let garbage = BoardFlash::with_content(vec![0x5A; 0x8000], 0);
    for (mut board, boot_up, inquired) in [
        (NodeRig::with_node_id(0x40), &["740: 00"][..], "5E 40"),
        (NodeRig::unconfigured(), &[], "5E FF"),
        (NodeRig::new(ADDRESS, defaults(0x40), garbage, 0), &["740: 00"], "5E 40"),
    ] {
        assert_eq!(board.power_cycle(), boot_up);
        assert_eq!(board.configure("5E"), [inquired]);
    }
}

#[test]
fn reset_node_makes_the_persistent_node_id_pending_and_active() {
    let mut board = NodeRig::with_node_id(0x40);
    board.configure("11 05, 17, 11 06");
    assert_eq!(board.nmt("81 40"), ["705: 00"]);
    assert_eq!(pending(&mut board), Some(0x05));
}

#[test]
fn reset_communication_makes_the_pending_node_id_active_stored_or_not() {
    let mut board = NodeRig::with_node_id(0x40);
    board.configure("11 05");
    assert_eq!(board.nmt("82 40"), ["705: 00"]);
    assert!(!board.is_in_configuration_state());
    assert_eq!(board.configure("5E"), ["5E 05"]);
    assert_eq!(board.power_cycle(), ["740: 00"], "it was not stored");
}

#[test]
fn cob_ids_follow_the_node_id() {
    let mut board = NodeRig::with_heartbeat(0x40, 100);
    board.configure("11 04");
    board.timeline();
    board.nmt("01 04");
    assert_eq!(board.node.nmt_state(), State::PreOperational, "04 is only pending");
    assert_eq!(board.nmt("82 40"), ["704: 00"]);
    assert_eq!(board.timeline(), ["0 ms node-ID 04", "0 ms 704: 00"], "the board gets it first");
    assert_eq!(board.pass_ms(100), ["704: 7F"]);
    assert_eq!(board.nmt("82 40"), SILENCE, "40 is another node now");
    assert_eq!(board.nmt("82 04"), ["704: 00"]);
}

#[test]
fn reset_communication_with_ff_pending_ends_communication() {
    let mut board = NodeRig::with_heartbeat(0x40, 100);
    board.nmt("01 00");
    board.configure("11 FF");
    board.timeline();
    assert_eq!(board.nmt("82 00"), SILENCE);
    assert_eq!(board.timeline(), ["0 ms node-ID FF"]);
    assert_eq!(board.node.nmt_state(), State::Initialisation);
    assert_eq!(board.pass_ms(1000), SILENCE);
    assert_eq!(board.sdo("40 18 10 00"), SILENCE);
    assert_eq!(board.lss("4C"), ["50"]);
    assert_eq!(board.configure("5E"), ["5E FF"]);
}

#[test]
fn leaving_configuration_with_a_first_node_id_starts_communication() {
    let mut board = NodeRig::with_heartbeat(0xFF, 100);
    assert_eq!(board.configure("11 04"), ["11 00"]);
    assert_eq!(board.pass_ms(1000), SILENCE, "not before the end of configuration");
    board.timeline();
    assert_eq!(board.lss("04 00"), ["704: 00"]);
    assert_eq!(board.timeline(), ["0 ms node-ID 04", "0 ms 704: 00"]);
    assert_eq!(board.node.nmt_state(), State::PreOperational);
    assert!(!board.is_in_configuration_state());
    assert_eq!(board.pass_ms(200), ["704: 7F", "704: 7F"]);
    assert_eq!(board.lss("04 00"), SILENCE, "once");
}

#[test]
fn store_makes_the_pending_values_persistent_and_leaves_the_active_ones() {
    let mut board = NodeRig::with_heartbeat(0x40, 1000);
    board.configure("11 05, 13 00 03");
    assert_eq!(board.lss("17"), ["17 00"]);
    let bit_rate = canopen_node::BitRate::Kbit250.into();
    assert_eq!(board.stored(), Some(Settings::new(bit_rate).with_node_id(NodeId::new(5))));
    assert_eq!(board.lss("5E"), ["5E 40"]);
    assert_eq!(board.bit_rate().kbit_per_s(), 1000);
    assert_eq!(board.power_cycle(), ["705: 00"]);
    assert_eq!(board.bit_rate().kbit_per_s(), 250);
    assert_eq!(board.pass_ms(1000), ["705: 7F"]);
}

#[test]
fn ff_is_storable_and_unconfigures_the_node() {
    let mut board = NodeRig::with_node_id(0x40);
    board.configure("11 FF");
    assert_eq!(board.lss("17"), ["17 00"]);
    assert_eq!(board.lss("5E"), ["5E 40"]);
    assert_eq!(board.power_cycle(), SILENCE);
    assert_eq!(board.lss("4C"), ["50"]);
}

#[test]
fn a_store_that_fails_is_answered_with_its_error_code() {
    let mut board = NodeRig::with_slow_stores();
    board.configure("17");
    assert_eq!(board.end_store(Err(StoreError::NotSupported)), ["17 01"]);
    board.lss("17");
    assert_eq!(board.end_store(Err(StoreError::MediumAccess)), ["17 02"]);
}

#[test]
fn a_store_refused_by_the_medium_is_answered_17_02_and_changes_nothing() {
    for operation in [Operation::Write, Operation::Read] {
        let mut board = NodeRig::with_node_id(0x40);
        board.configure("11 05, 17, 11 06");
        board.flash.fail(operation);
        assert_eq!(board.lss("17"), ["17 02"], "{operation:?}");
        assert_eq!(stored(&board), Some(0x05));
        board.flash.repair();
        assert_eq!(board.power_cycle(), ["705: 00"], "{operation:?}");
    }
}

#[test]
fn a_store_that_reads_back_differently_is_answered_17_02() {
    // The node-ID in the records of the first two stores, behind the two that formatting writes.
    const NODE_ID_AT: [usize; 2] = [2 * 40 + 9, 3 * 40 + 9];
    let mut board = NodeRig::with_node_id(0x40);
    board.configure("11 05");
    board.flash.stick(NODE_ID_AT[1], 0x01, true);
    assert_eq!(board.lss("17"), ["17 00"]);
    assert_eq!(board.flash.content()[NODE_ID_AT[0]], 0x05);
    board.lss("11 04");
    assert_eq!(board.lss("17"), ["17 02"]);
    assert_eq!(board.power_cycle(), ["705: 00"]);
}

#[test]
fn a_running_store_survives_reset_communication_and_is_answered() {
    let mut board = NodeRig::with_slow_stores();
    board.configure("11 05, 17");
    assert_eq!(board.nmt("82 00"), ["705: 00"]);
    assert_eq!(board.finish_store(), ["17 00"]);
    assert_eq!(board.power_cycle(), ["705: 00"]);
}

#[test]
fn a_byte_that_is_no_node_id_and_a_store_that_fails_say_why() {
    let invalid = NodeId::from_lss(0x80).unwrap_err();
    assert_eq!(invalid.to_string(), "neither a node-ID (1 to 127) nor FFh");
    for (error, why) in [
        (StoreError::NotSupported, "the device cannot store"),
        (StoreError::MediumAccess, "the storage medium failed"),
        (StoreError::Full, "the storage medium is full until the next start"),
    ] {
        assert_eq!(error.to_string(), why);
    }
}
