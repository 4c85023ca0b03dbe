//! The sessions found in manuals: a node gets another node-ID and another bit rate, and keeps them.

use testkit::{frames::SILENCE, node_rig::NodeRig};

#[test]
fn a_node_gets_node_id_4_and_500_kbit_per_s_and_comes_back_with_them() {
    let mut node = NodeRig::with_node_id(0x40);
    assert_eq!(node.bit_rate().kbit_per_s(), 1000);
    assert_eq!(node.lss("04 01"), SILENCE);
    assert_eq!(node.lss("5E"), ["5E 40"]);
    assert_eq!(node.lss("11 04"), ["11 00"]);
    assert_eq!(node.lss("13 00 02"), ["13 00"]);
    assert_eq!(node.lss("17"), ["17 00"]);
    assert_eq!(node.lss("04 00"), SILENCE, "no answer and no boot-up");
    assert_eq!(node.pass_ms(1000), SILENCE);
    assert_eq!(node.bit_rate().kbit_per_s(), 1000);
    assert_eq!(node.nmt("81 40"), ["704: 00"]);
    assert_eq!(node.bit_rate().kbit_per_s(), 500);
}

#[test]
fn an_unconfigured_node_is_found_gets_a_node_id_and_boots_up_at_once() {
    let mut node = NodeRig::unconfigured();
    assert_eq!(node.lss("4C"), ["50"]);
    assert_eq!(node.lss("40 44 33 22 11"), SILENCE);
    assert_eq!(node.lss("41 88 77 66 55"), SILENCE);
    assert_eq!(node.lss("42 03 02 01 00"), SILENCE);
    assert_eq!(node.lss("43 EF BE AD DE"), ["44"]);
    assert_eq!(node.lss("11 04"), ["11 00"]);
    assert_eq!(node.lss("17"), ["17 00"]);
    assert_eq!(node.lss("04 00"), ["704: 00"]);
    assert_eq!(node.lss("4C"), SILENCE);
    assert_eq!(node.power_cycle(), ["704: 00"]);
}
