//! The supervision of the release image at moments that are rare.

use crate::{
    rig::*,
    uptime::{booted_at, skip_40_minutes},
};

const RATE: BitRate = BitRate::Kbit1000;
const OTHER_RATE: BitRate = BitRate::Kbit250;

/// A node with a core that is 40 times slower, at another rate than the master.
fn slow_node() -> ImageRig {
    let slow = chip(ChipVariant { slowdown: 40, ..ChipVariant::default() });
    let mut rig = ImageRig::new(RATE, [board_of(slow, settings(0x40, OTHER_RATE))]);
    rig.collect(Time::from_ms(100));
    rig
}

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
fn a_guest_may_become_error_passive_by_the_error_that_sends_it_home() {
    let mut rig = slow_node();
    assert_is_found(&mut rig);
    rig.collect(Time::from_s(1));
    assert!(is_at(&rig, RATE), "it is a guest at the rate of the master");
    let since = rig.network.now();
    let error = rig.bit_time() * 50;
    rig.short_circuit(Short::Dominant, error);
    rig.network.run_for(Time::from_ms(30));
    assert_eq!(rig.bit_rates(0, since), [], "a guest bears one error");
    rig.short_circuit(Short::Dominant, Time::from_ms(2));
    rig.network.run_for(Time::from_ms(30));
    let rates = rig.bit_rates(0, since);
    // The first change is the reset of the controller.
    assert_eq!(rates[1].1, bit_per_s(OTHER_RATE), "it goes home: {rates:?}");
}

#[test]
fn a_deadline_of_a_search_may_pass_just_before_a_frame_is_handled() {
    let mut rig = slow_node();
    // A boot-up does not end a search.
    let boot_up = canopen_node::Frame::new(0x702, &[0]).expect("a frame");
    let until = rig.network.now() + Time::from_s(5);
    while rig.network.now() < until {
        if rig.network.adapter_mut(rig.master).unsent() == 0 {
            rig.queue(&boot_up);
        }
        rig.network.run_for(Time::from_ms(1));
    }
    rig.network.adapter_mut(rig.master).close();
    rig.network.adapter_mut(rig.master).open();
    assert_is_found(&mut rig);
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
