//! Bus-off before, during and after a switch of the bit rate, caused by a foreign node at an undefined rate.

use crate::rig::*;

/// Node 40 at 500 kbit/s with a heartbeat, in LSS configuration state and about to switch to 250 kbit/s; and the
/// foreign node.
fn about_to_switch() -> (ImageRig, AdapterId) {
    let settings = settings(0x40, BitRate::Kbit500).with_heartbeat_ms(20);
    let mut rig = rig_with(settings);
    let foreign = rig.add_disturber();
    rig.lss("04 01, 13 00 03");
    (rig, foreign)
}

/// Only the foreign node sends for `span`.
fn disturb(rig: &mut ImageRig, foreign: AdapterId, span: Time) {
    rig.disturb(foreign, Id::Standard(0x7FF), Time::from_ms(1), span);
}

fn went_bus_off(rig: &ImageRig, since: Time) -> bool {
    rig.did(0, since).any(|event| event.what == What::BusOff)
}

/// The master asks until node 40 answers at its bit rate, for five seconds.
fn assert_is_reached(rig: &mut ImageRig) {
    rig.reach("5E", "5E 40", Time::from_s(5));
}

fn switch(rig: &mut ImageRig) {
    rig.activate(50);
    rig.network.run_for(Time::from_ms(50));
    rig.set_master_bit_rate(BitRate::Kbit250);
    rig.network.run_for(Time::from_ms(52));
}

#[test]
fn a_board_that_was_bus_off_before_the_switch_switches_like_others() {
    let (mut rig, _) = about_to_switch();
    rig.short_circuit(Short::Recessive, Time::from_s(1));
    assert!(went_bus_off(&rig, Time::ZERO));
    assert_is_reached(&mut rig);
    switch(&mut rig);
    assert_is_reached(&mut rig);
}

#[test]
fn a_board_never_goes_bus_off_in_the_switch_delays() {
    let (mut rig, foreign) = about_to_switch();
    rig.activate(1000);
    let t0 = rig.network.now();
    disturb(&mut rig, foreign, Time::from_ms(1_990));
    assert!(!went_bus_off(&rig, t0), "it sends nothing that could fail");
    rig.set_master_bit_rate(BitRate::Kbit250);
    assert_is_reached(&mut rig);
}

#[test]
fn a_board_that_goes_bus_off_after_the_switch_is_reached_at_the_new_rate() {
    let (mut rig, foreign) = about_to_switch();
    switch(&mut rig);
    assert_is_reached(&mut rig);
    let since = rig.network.now();
    disturb(&mut rig, foreign, Time::from_s(1));
    assert!(went_bus_off(&rig, since));
    assert_is_reached(&mut rig);
}
