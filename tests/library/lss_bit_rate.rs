//! The bit rate, persistent, pending and active (CiA 305, configure bit timing parameters).

use canopen_node::{BitRate, BitRateSetting, BitRates, Node};
use testkit::{
    frames::Frames,
    node_rig::{ADDRESS, NodeRig, defaults, device},
};

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
fn a_rate_stored_by_17_is_active_after_power_on_and_reset_node() {
    let restarts: [fn(&mut NodeRig) -> Frames; 2] =
        [NodeRig::power_cycle, |board| board.nmt("81 00")];
    for restart in restarts {
        let mut board = with_500_pending();
        restart(&mut board);
        assert_eq!(board.bit_rate(), BitRate::Kbit1000, "13 alone is not kept");
        board.lss("04 01");
        assert_eq!(pending(&mut board), 1000, "13 alone is not kept");
        board.lss("13 00 02");
        board.lss("17");
        assert_eq!(board.bit_rate(), BitRate::Kbit1000);
        board.lss("13 00 03");
        restart(&mut board);
        assert_eq!(board.bit_rate(), BitRate::Kbit500);
        board.lss("04 01");
        assert_eq!(pending(&mut board), 500);
    }
}

#[test]
fn activation_stores_nothing() {
    let mut board = with_500_pending();
    board.lss("15 00 00");
    assert_eq!(board.bit_rate(), BitRate::Kbit500);
    board.power_cycle();
    assert_eq!(board.bit_rate(), BitRate::Kbit1000);
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
