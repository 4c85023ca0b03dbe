//! The supervision of the release image at moments that are rare.

use crate::{
    rig::*,
    uptime::{booted_at, skip_40_minutes},
};

const RATE: BitRate = BitRate::Kbit1000;
const OTHER_RATE: BitRate = BitRate::Kbit250;

/// The master asks node 40 until it answers, which takes a node at a wrong rate at most this long.
fn assert_is_found(rig: &mut ImageRig) {
    let read = sdo::request(0x40, "40 00 10 00");
    let time = rig.poll_until(&read, Time::from_ms(1_500), |answer| answer.cob_id() == 0x5C0);
    assert!(time.is_some(), "node 40 is not found");
}

/// Whether the node takes part at this rate.
fn is_at(rig: &ImageRig, rate: BitRate) -> bool {
    let chip = rig.network.board(0).chip();
    let can = chip.can(1);
    can.bit_rate() == bit_per_s(rate) && !can.is_silent()
}

#[test]
fn a_board_searches_and_comes_home_whatever_the_count() {
    for count in [0, 0x4000_0000, 0x8000_0000, 0xC000_0000, (-3_000_000_i32).cast_unsigned()] {
        let mut rig = booted_at(count, OTHER_RATE);
        assert_is_found(&mut rig);
        assert!(is_at(&rig, OTHER_RATE), "{count:X}: at the rate of the others");
        rig.set_master_bit_rate(RATE);
        assert_is_found(&mut rig);
        assert!(is_at(&rig, RATE), "{count:X}: at home again");
    }
}

#[test]
fn a_boot_up_that_is_repeated_after_half_an_hour_restarts_the_heartbeat() {
    let mut rig = node_40(1000);
    rig.network.adapter_mut(rig.master).close();
    rig.power_cycle(0);
    let since = rig.network.now();
    while !rig.did(0, since).any(|event| matches!(event.what, What::Aborted { .. })) {
        rig.network.run_for(Time::from_ms(1));
    }
    rig.network.adapter_mut(rig.master).open();
    skip_40_minutes(&mut rig, &frames::request("04 00"));
    assert_eq!(rig.collect(Time::from_ms(900)).texts()[0], "740: 00");
    assert_eq!(rig.collect(Time::from_ms(200)).texts(), ["740: 7F"]);
}
