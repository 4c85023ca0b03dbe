//! The settings of LSS where no case can look: what a product offers, what its flash does, and stores that take time.

use canopen_node::{
    BitRate, BitRateSetting, BitRates, Node, NodeId,
    lss::{Address, StoreError},
};
use testkit::{
    flash::{BoardFlash, Operation},
    node_rig::{ADDRESS, NodeRig, defaults, device},
};

/// The stored node-ID, as LSS encodes it.
fn stored(board: &NodeRig) -> Option<u8> {
    board.stored().map(|settings| NodeId::to_lss(settings.node_id))
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

#[test]
fn requests_are_answered_while_a_store_is_running_and_none_is_lost() {
    let mut board = NodeRig::with_slow_stores();
    assert_eq!(
        board.configure("11 05, 17, 5D, 11 06, 17, 17, 04 00"),
        ["11 00", "5D EF BE AD DE", "11 00"]
    );
    assert!(!board.is_in_configuration_state());
    assert_eq!(board.finish_store(), ["17 00"]);
    assert_eq!(board.finish_store(), ["17 00"]);
    assert_eq!(board.finish_store(), ["17 00"]);
    assert_eq!(board.power_cycle(), ["706: 00"]);
}

/// A board that has just answered `13 00 02` (500 kbit/s).
fn with_500_pending() -> NodeRig {
    with_500_pending_on(NodeRig::with_node_id(0x40))
}

fn with_500_pending_on(mut board: NodeRig) -> NodeRig {
    assert_eq!(board.configure("13 00 02"), ["13 00"]);
    board
}

/// The pending bit rate, determined by activating it.
fn pending(board: &mut NodeRig) -> u16 {
    board.lss("15 00 00");
    board.bit_rate().kbit_per_s()
}

#[test]
fn a_rate_that_a_product_leaves_out_is_refused_and_changes_nothing() {
    let rates = BitRates::possible(40_000_000).with_automatic();
    let rates = rates.without(BitRate::Kbit1000).without(BitRate::Kbit10);
    let defaults = defaults(0x40).with_bit_rate(BitRate::Kbit125.into());
    let device = device(ADDRESS).with_bit_rates(rates).with_defaults(defaults);
    let mut board = with_500_pending_on(NodeRig::of(device));
    for (index, answer) in [(0, "13 01"), (1, "13 00"), (7, "13 00"), (8, "13 01"), (9, "13 00")] {
        assert_eq!(board.lss(&format!("13 00 {index:02X}")), [answer], "index {index}");
    }
    assert_eq!(board.lss("13 00 02"), ["13 00"]);
    assert_eq!(board.lss("13 00 00"), ["13 01"]);
    assert_eq!(pending(&mut board), 500);
    assert_eq!(rates.fastest(), BitRate::Kbit800);
}

#[test]
fn a_set_of_rates_without_one_has_the_others_and_one_of_one_no_other() {
    let all = BitRates::possible(40_000_000);
    for rate in BitRate::ALL {
        for other in BitRate::ALL {
            assert_eq!(all.without(rate).contains(other), rate != other, "{rate} and {other}");
            assert_eq!(BitRates::only(rate).contains(other), rate == other, "{rate} and {other}");
        }
    }
}

#[test]
fn reset_communication_touches_neither_the_active_nor_the_pending_rate() {
    let mut board = with_500_pending();
    board.nmt("82 00");
    assert_eq!(board.bit_rate(), BitRate::Kbit1000);
    board.lss("04 01");
    assert_eq!(pending(&mut board), 500);
    board.lss("13 00 03");
    board.nmt("82 00");
    assert_eq!(board.bit_rate(), BitRate::Kbit500);
    board.lss("04 01");
    assert_eq!(pending(&mut board), 250);
}

#[test]
fn an_unsupported_stored_bit_rate_is_searched_for_by_listening() {
    let device = device(ADDRESS).with_bit_rates(BitRates::possible(42_000_000));
    assert!(!device.bit_rates.contains(BitRate::Kbit800), "{:?}", device.bit_rates);
    let settings = defaults(0x40).with_bit_rate(BitRate::Kbit800.into());
    let node = Node::new(device, Some(settings));
    assert!(node.is_listening());
    assert!(device.bit_rates.contains(node.bit_rate()));
}

#[test]
fn a_setting_is_written_as_its_rate_or_as_automatic() {
    assert_eq!(BitRateSetting::Fixed(BitRate::Kbit125).to_string(), "125 kbit/s");
    assert_eq!(BitRateSetting::Automatic.to_string(), "automatic");
}

#[test]
fn the_serial_number_of_a_unique_id_is_its_fnv_1a_hash() {
    for (id, hash) in [
        (&b""[..], 0x811C_9DC5),
        (b"a", 0xE40C_292C),
        (b"b", 0xE70C_2DE5),
        (b"foobar", 0xBF9C_F968),
    ] {
        assert_eq!(Address::serial_number_of(id), hash, "{id:?}");
        let device = device(ADDRESS).with_serial_number(hash);
        assert_eq!(device.address, Address { serial_number: hash, ..ADDRESS });
    }
}

#[test]
fn an_lss_address_in_bytes_has_each_number_from_its_lowest_byte_on() {
    let bytes = *b"\x01\x02\x03\x04\x05\x06\x07\x08\x09\x0A\x0B\x0C\x0D\x0E\x0F\x10";
    let address = Address::from([0x0403_0201, 0x0807_0605, 0x0C0B_0A09, 0x100F_0E0D]);
    assert_eq!(address.to_le_bytes(), bytes);
    assert_eq!(Address::from_le_bytes(bytes), address);
}
