//! Fastscan (CiA 305): each rule of a step, and whole scans by a master with little prior knowledge.

use canopen_node::lss::{Address, AddressPart};
use lss_master::{Fastscan, Master, Timing};
use testkit::{
    frames::{self, SILENCE, number},
    node_rig::{ADDRESS, NodeRig},
    random::Random,
    rig_bus::{RigBus, neighbours},
};

const BEGIN: &str = "51 00 00 00 00 80";

fn step(id_number: u32, bit_check: u8, sub: u8, next: u8) -> String {
    format!("51 {} {bit_check:02X} {sub:02X} {next:02X}", number(id_number))
}

/// A slave that has answered the start of a scan.
fn begun() -> NodeRig {
    let mut board = NodeRig::unconfigured();
    assert_eq!(board.lss(BEGIN), ["4F"]);
    board
}

fn bus(slaves: impl IntoIterator<Item = NodeRig>) -> RigBus {
    RigBus::new(slaves, Random::from_environment())
}

/// The LSS address that a scan finds; its slave is in LSS configuration state then.
fn scan(bus: &mut RigBus, scan: Fastscan) -> Option<Address> {
    bus.run(&mut Master::new(Timing::default()), scan).expect("the answers are consistent")
}

#[test]
fn every_unconfigured_slave_in_waiting_answers_the_start_of_a_scan() {
    let mut board = NodeRig::unconfigured();
    assert_eq!(board.lss("51 00 00 00 00 80 00 00"), ["4F 00 00 00 00 00 00 00"]);
    assert_eq!(board.lss("51 FF FF FF FF 80 FF FF"), ["4F"]);
}

#[test]
fn a_step_with_a_field_out_of_range_is_ignored_and_does_not_end_the_scan() {
    let mut board = begun();
    let vendor_id = ADDRESS.vendor_id;
    for value in 0..=0xFF {
        if value > 0x1F && value != 0x80 {
            assert_eq!(board.lss(&step(vendor_id, value, 0, 1)), SILENCE, "BitCheck {value:02X}");
        }
        if value > 3 {
            assert_eq!(board.lss(&step(vendor_id, 0, value, 0)), SILENCE, "Sub {value:02X}");
            assert_eq!(board.lss(&step(vendor_id, 0, 0, value)), SILENCE, "Next {value:02X}");
        }
    }
    assert!(!board.is_in_configuration_state());
    assert_eq!(board.lss(&step(vendor_id, 0, 0, 1)), ["4F"]);
}

#[test]
fn a_step_for_another_part_than_the_one_awaited_is_ignored() {
    let parts: [u32; 4] = ADDRESS.into();
    for awaited in 0..4 {
        for sub in 0..4 {
            let mut board = begun();
            assert_eq!(board.lss(&step(parts[0], 0, 0, awaited)), ["4F"]);
            let answers = board.lss(&step(parts[usize::from(sub)], 0, sub, sub));
            let expected: &[&str] = if sub == awaited { &["4F"] } else { &[] };
            assert_eq!(answers, expected, "awaited {awaited}, sub {sub}");
        }
    }
}

#[test]
fn the_bits_from_bit_check_upwards_are_compared_and_no_others() {
    for bit_check in 0..32 {
        for wrong_bit in 0..32 {
            let mut board = begun();
            let id_number = ADDRESS.vendor_id ^ 1 << wrong_bit;
            let answers = board.lss(&step(id_number, bit_check, 0, 0));
            let expected: &[&str] = if wrong_bit < bit_check { &["4F"] } else { &[] };
            assert_eq!(answers, expected, "BitCheck {bit_check}, bit {wrong_bit} wrong");
        }
    }
}

#[test]
fn only_a_full_match_that_returns_to_an_earlier_part_selects_a_slave() {
    let parts: [u32; 4] = ADDRESS.into();
    for sub in 0..4 {
        for next in 0..4 {
            for bit_check in [0, 1, 31] {
                let mut board = begun();
                assert_eq!(board.lss(&step(parts[0], 0, 0, sub)), ["4F"]);
                let last = step(parts[usize::from(sub)], bit_check, sub, next);
                assert_eq!(board.lss(&last), ["4F"]);
                let is_selected = bit_check == 0 && next < sub;
                assert_eq!(board.is_in_configuration_state(), is_selected, "{last}");
            }
        }
    }
}

#[test]
fn each_accepted_04_and_each_reset_awaits_the_first_part_again() {
    for (event, is_reset) in [
        ("04 00", true),
        ("04 02", false),
        ("000: 81 00", true),
        ("000: 82 00", true),
        ("000: 01 00", false),
        ("000: 82 05", false),
    ] {
        let mut board = begun();
        assert_eq!(board.lss(&step(ADDRESS.vendor_id, 0, 0, 1)), ["4F"]);
        board.receive(&frames::of_master(event));
        let first = board.lss(&step(ADDRESS.vendor_id, 0, 0, 0));
        assert_eq!(first, if is_reset { &["4F"][..] } else { &[][..] }, "{event}");
    }
}

#[test]
fn the_three_frames_that_crash_other_slaves_do_no_harm() {
    let mut board = NodeRig::unconfigured();
    assert_eq!(board.lss("51 00 00 00 00 80 00 00"), ["4F"]);
    assert_eq!(board.lss("51 44 33 22 11 00 00 09"), SILENCE);
    assert_eq!(board.lss("51 44 33 22 11 00 09 00"), SILENCE);
    assert_eq!(scan(&mut bus([board]), Fastscan::new()), Some(ADDRESS));
}

#[test]
fn a_master_that_knows_nothing_finds_all_slaves_one_by_one() {
    let mut random = Random::from_environment();
    for _ in 0..5 {
        let addresses = neighbours(&mut random, 8);
        let mut bus = bus(addresses.iter().copied().map(NodeRig::with_address));
        let mut found: Vec<[u32; 4]> = Vec::new();
        for node_id in 1..=addresses.len() as u8 {
            let address = scan(&mut bus, Fastscan::new()).expect("one more slave is unconfigured");
            let rigs = bus.slaves.iter_mut().map(|slave| &mut slave.rig);
            let mut selected: Vec<_> =
                rigs.filter_map(|rig| rig.inquired_node_id().map(|_| rig)).collect();
            assert_eq!(selected.len(), 1, "one slave is in LSS configuration state");
            assert_eq!(selected[0].node.lss().address(), address);
            assert_eq!(selected[0].lss(&format!("11 {node_id:02X}")), ["11 00"]);
            for slave in &mut bus.slaves {
                slave.rig.lss("04 00");
            }
            found.push(address.into());
        }
        assert_eq!(scan(&mut bus, Fastscan::new()), None, "none is left");
        found.sort_unstable();
        let mut expected: Vec<[u32; 4]> = addresses.into_iter().map(Into::into).collect();
        expected.sort_unstable();
        assert_eq!(found, expected);
    }
}

#[test]
fn a_master_that_knows_parts_confirms_them_in_one_step_each() {
    for known in 0..16 {
        let mut with_known = Fastscan::new();
        for part in (0..4).filter(|part| known >> part & 1 == 1).filter_map(AddressPart::new) {
            with_known = with_known.with_known(part, <[u32; 4]>::from(ADDRESS)[part as usize]);
        }
        // A scan tests for 0 bits first, so it leads to the lower of two slaves.
        let other = NodeRig::with_address([u32::MAX; 4].into());
        let mut bus = bus([NodeRig::unconfigured(), other]);
        assert_eq!(scan(&mut bus, with_known), Some(ADDRESS), "{known:04b}");
        assert!(bus.slaves[0].rig.is_in_configuration_state());
        assert!(!bus.slaves[1].rig.is_in_configuration_state());
    }
}

#[test]
fn a_scan_for_a_slave_that_is_not_there_selects_none() {
    let mut bus = bus([NodeRig::unconfigured()]);
    let absent = Fastscan::new().with_known(AddressPart::VendorId, 7);
    assert_eq!(scan(&mut bus, absent), None);
    assert!(!bus.slaves[0].rig.is_in_configuration_state());
}
