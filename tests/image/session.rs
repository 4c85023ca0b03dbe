//! Sessions of an LSS master with the release image on emulated boards, frame by frame.

use firmware::device::DEVICE;

use crate::rig::*;

/// Restarts the board by NMT; returns its boot-up at its new bit rate.
fn reset_node(rig: &mut ImageRig, node_id: u8, then: BitRate) -> Frames {
    rig.network.allow_reset(0, ResetCause::Software);
    rig.transmit_command(&format!("81 {node_id:02X}"));
    rig.set_master_bit_rate(then);
    let boot_up = rig.collect(Time::from_ms(20));
    let (_, bit_rate) = rig.bit_rates(0, Time::ZERO).pop().expect("set at the start");
    assert_eq!(bit_rate, bit_per_s(then));
    boot_up
}

#[test]
fn node_40_at_1_mbit_per_s_becomes_node_4_at_500_kbit_per_s() {
    let mut rig = node_40(0);
    assert_eq!(rig.lss("04 01, 5E, 11 04, 13 00 02, 17"), ["5E 40", "11 00", "13 00", "17 00"]);
    assert_eq!(rig.lss("04 00"), SILENCE, "no answer and no boot-up");
    assert_eq!(rig.collect(Time::from_ms(1000)), SILENCE);
    assert_eq!(reset_node(&mut rig, 0x40, BitRate::Kbit500), ["704: 00"]);
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(20)), ["704: 00"]);
}

#[test]
fn a_new_board_gets_its_node_id_and_bit_rate_and_comes_back_with_them() {
    let mut rig = blank_rig();
    assert_eq!(rig.collect(Time::from_ms(1500)), SILENCE, "neither boot-up nor heartbeat");
    assert_eq!(rig.lss("4C, 04 01, 5E, 11 04, 13 00 02"), ["50", "5E FF", "11 00", "13 00"]);
    assert_eq!(rig.lss("17, 4C"), ["17 00"]);
    assert_eq!(rig.lss("04 00"), ["704: 00"], "boots up at once, at the previous bit rate");
    let heartbeat = Time::from_ms(DEVICE.heartbeat_ms.into());
    assert_eq!(rig.collect(heartbeat + Time::from_ms(20)), ["704: 7F"], "the default heartbeat");
    assert_eq!(reset_node(&mut rig, 0x04, BitRate::Kbit500), ["704: 00"]);
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(20)), ["704: 00"]);
    assert_eq!(rig.lss("4C"), SILENCE);
}

#[test]
fn equal_answers_of_several_boards_are_one_frame() {
    let mut rig = ImageRig::new(BitRate::Kbit125, [1, 2, 3, 4].map(blank_board));
    assert_eq!(rig.lss("4C, 51 00 00 00 00 80, 04 01, 13 00 00"), ["50", "4F", "13 00"]);
    assert_eq!(rig.lss("5A").0.len(), 1);
    assert!(rig.errors().is_empty());
}

#[test]
fn the_node_id_ff_takes_a_board_out_of_the_network() {
    let mut rig = rig_with(settings(0x40, BitRate::Kbit1000).with_heartbeat_ms(100));
    assert_eq!(rig.collect(Time::from_ms(150)), ["740: 00", "740: 7F"]);
    assert_eq!(rig.lss("04 01, 11 FF, 17"), ["11 00", "17 00"]);
    assert_eq!(rig.lss("4C"), SILENCE, "node-ID 40 is still active");
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(1000)), SILENCE);
    assert_eq!(rig.lss("4C"), ["50"]);
}
