//! Fastscan (CiA 305): each rule of a step. `libs/lss-master/tests/network.rs` has whole scans.

use testkit::{
    frames::{SILENCE, number},
    node_rig::{ADDRESS, NodeRig},
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
fn the_part_awaited_is_answered_and_a_full_match_that_goes_back_selects() {
    let parts: [u32; 4] = ADDRESS.into();
    for case in 0..4 * 4 * 4 * 3 {
        let [awaited, sub, next] = [case, case / 4, case / 16].map(|number| number as u8 % 4);
        let bit_check = [0, 1, 31][case / 64];
        let mut board = begun();
        assert_eq!(board.lss(&step(parts[0], 0, 0, awaited)), ["4F"]);
        let last = step(parts[usize::from(sub)], bit_check, sub, next);
        let expected: &[&str] = if sub == awaited { &["4F"] } else { &[] };
        assert_eq!(board.lss(&last), expected, "awaited {awaited}, {last}");
        let is_selected = sub == awaited && bit_check == 0 && next < sub;
        assert_eq!(board.is_in_configuration_state(), is_selected, "awaited {awaited}, {last}");
    }
}
