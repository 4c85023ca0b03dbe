//! Bus-off before, during and after a switch of the bit rate, caused by a foreign node at an undefined rate.

use emulator::{
    Time,
    can::{Frame, Id},
    network::{AdapterId, Short, What},
};
use lss_slave::BitRate;
use testkit::image_rig::{ImageRig, settings};

/// Node 40 at 500 kbit/s with a heartbeat, in LSS configuration state and about to switch to 250 kbit/s; and the
/// foreign node.
fn about_to_switch() -> (ImageRig, AdapterId) {
    let settings = settings(0x40, BitRate::Kbit500).with_heartbeat_ms(20);
    let mut bench = ImageRig::with(settings);
    let foreign = bench.add_disturber();
    bench.lss("04 01");
    bench.lss("13 00 03");
    (bench, foreign)
}

/// Only the foreign node sends for `span`.
fn disturb(bench: &mut ImageRig, foreign: AdapterId, span: Time) {
    bench.disturb(foreign, Id::Standard(0x7FF), Time::from_ms(1), span);
}

fn went_bus_off(bench: &ImageRig, since: Time) -> bool {
    bench.did(0, since).any(|event| event.what == What::BusOff)
}

/// The master asks until node 40 answers at its bit rate, for five seconds.
fn assert_is_reached(bench: &mut ImageRig) {
    let until = bench.network.now() + Time::from_s(5);
    let answer = Frame::data(Id::Standard(0x7E4), &[0x5E, 0x40, 0, 0, 0, 0, 0, 0]);
    while bench.network.now() < until {
        bench
            .network
            .send(bench.master, Frame::data(Id::Standard(0x7E5), &[0x5E, 0, 0, 0, 0, 0, 0, 0]));
        bench.network.run_for(Time::from_ms(100));
        while let Some((_, frame)) = bench.network.receive(bench.master) {
            if frame == answer {
                return;
            }
        }
    }
    panic!("node 40 is lost");
}

fn switch(bench: &mut ImageRig) {
    bench.transmit_request("15 32 00");
    bench.network.run_for(Time::from_ms(50));
    bench.set_master_bit_rate(BitRate::Kbit250);
    bench.network.run_for(Time::from_ms(52));
}

#[test]
fn a_board_that_was_bus_off_before_the_switch_switches_like_others() {
    let (mut bench, _) = about_to_switch();
    bench.network.set_short(Some(Short::Recessive));
    bench.network.run_for(Time::from_s(1));
    bench.network.set_short(None);
    assert!(went_bus_off(&bench, Time::ZERO));
    assert_is_reached(&mut bench);
    switch(&mut bench);
    assert_is_reached(&mut bench);
}

#[test]
fn a_board_never_goes_bus_off_in_the_switch_delays() {
    let (mut bench, foreign) = about_to_switch();
    bench.transmit_request("15 E8 03");
    let t0 = bench.network.now();
    disturb(&mut bench, foreign, Time::from_ms(1_990));
    assert!(!went_bus_off(&bench, t0), "it sends nothing that could fail");
    bench.set_master_bit_rate(BitRate::Kbit250);
    assert_is_reached(&mut bench);
}

#[test]
fn a_board_that_goes_bus_off_after_the_switch_is_reached_at_the_new_rate() {
    let (mut bench, foreign) = about_to_switch();
    switch(&mut bench);
    assert_is_reached(&mut bench);
    let since = bench.network.now();
    disturb(&mut bench, foreign, Time::from_s(1));
    assert!(went_bus_off(&bench, since));
    assert_is_reached(&mut bench);
}
