//! The indicators of the release image (CiA 303-3), observed on the pins of the emulated board.

use emulator::{Time, chip::Pin};
use lss_slave::BitRate;
use testkit::image_rig::{ImageRig, settings};

const RUN: Pin = Pin('D', 12);
const ERR: Pin = Pin('D', 14);

/// The states of a pin for 2.4 s, two periods of the longest pattern, from its next rising edge on: `#` is 50 ms of
/// light.
fn pattern(bench: &mut ImageRig, pin: Pin) -> String {
    let is_lit = |bench: &ImageRig| bench.network.board(0).output(pin).level == Some(true);
    let mut patience = 2_500;
    while is_lit(bench) && patience > 0 {
        bench.network.run_for(Time::from_ms(1));
        patience -= 1;
    }
    while !is_lit(bench) && patience > 0 {
        bench.network.run_for(Time::from_ms(1));
        patience -= 1;
    }
    bench.network.run_for(Time::from_ms(25));
    let mut seen = String::new();
    for _ in 0..48 {
        seen.push(if is_lit(bench) { '#' } else { '.' });
        bench.network.run_for(Time::from_ms(50));
    }
    seen
}

fn operational() -> ImageRig {
    let mut bench = ImageRig::with(settings(0x40, BitRate::Kbit500));
    bench.collect(Time::from_ms(20));
    bench.nmt("01 40");
    bench
}

#[test]
fn run_shows_the_nmt_state_and_err_is_dark_while_all_is_well() {
    let mut bench = operational();
    assert_eq!(pattern(&mut bench, RUN), "#".repeat(48));
    bench.nmt("80 40");
    assert_eq!(pattern(&mut bench, RUN), "####....".repeat(6));
    bench.nmt("02 40");
    assert_eq!(pattern(&mut bench, RUN), "####....................".repeat(2));
    assert_eq!(pattern(&mut bench, ERR), ".".repeat(48));
}

#[test]
fn both_flicker_in_turn_in_lss_configuration_state_and_without_a_node_id() {
    let mut configured = operational();
    configured.lss("04 01");
    for mut bench in [configured, ImageRig::blank()] {
        assert_eq!(pattern(&mut bench, RUN), "#.".repeat(24));
        for _ in 0..20 {
            let board = bench.network.board(0);
            assert_ne!(board.output(RUN).level, board.output(ERR).level);
            bench.network.run_for(Time::from_ms(50));
        }
    }
}

#[test]
fn err_flashes_once_while_the_error_counters_warn() {
    let mut bench = ImageRig::with(settings(0x40, BitRate::Kbit500).with_heartbeat_ms(100));
    bench.collect(Time::from_ms(20));
    // No other node acknowledges: the transmit error counter rises to 128 and stays there.
    bench.network.adapter_mut(bench.master).close();
    bench.network.run_for(Time::from_ms(300));
    assert_eq!(pattern(&mut bench, ERR), "####....................".repeat(2));
}
