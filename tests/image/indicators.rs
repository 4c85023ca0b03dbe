//! The indicators of the release image (CiA 303-3), observed on the pins of the emulated board.

use crate::rig::*;

const RUN: Pin = Pin('D', 12);
const ERR: Pin = Pin('D', 14);

/// The states of a pin for 2.4 s, two periods of the longest pattern, from its next rising edge on: `#` is 50 ms of
/// light.
fn pattern(rig: &mut ImageRig, pin: Pin) -> String {
    let is_lit = |rig: &ImageRig| rig.network.board(0).output(pin).level == Some(true);
    let mut patience = 2_500;
    while is_lit(rig) && patience > 0 {
        rig.network.run_for(Time::from_ms(1));
        patience -= 1;
    }
    while !is_lit(rig) && patience > 0 {
        rig.network.run_for(Time::from_ms(1));
        patience -= 1;
    }
    rig.network.run_for(Time::from_ms(25));
    let mut seen = String::new();
    for _ in 0..48 {
        seen.push(if is_lit(rig) { '#' } else { '.' });
        rig.network.run_for(Time::from_ms(50));
    }
    seen
}

fn operational() -> ImageRig {
    let mut rig = rig_with(settings(0x40, BitRate::Kbit500));
    rig.collect(Time::from_ms(20));
    rig.nmt("01 40");
    rig
}

#[test]
fn run_shows_the_nmt_state_and_err_is_dark_while_all_is_well() {
    let mut rig = operational();
    assert_eq!(pattern(&mut rig, RUN), "#".repeat(48));
    rig.nmt("80 40");
    assert_eq!(pattern(&mut rig, RUN), "####....".repeat(6));
    rig.nmt("02 40");
    assert_eq!(pattern(&mut rig, RUN), "####....................".repeat(2));
    assert_eq!(pattern(&mut rig, ERR), ".".repeat(48));
}

#[test]
fn both_flicker_in_turn_in_lss_configuration_state_and_without_a_node_id() {
    let mut configured = operational();
    configured.lss("04 01");
    for mut rig in [configured, blank_rig()] {
        assert_eq!(pattern(&mut rig, RUN), "#.".repeat(24));
        for _ in 0..20 {
            let board = rig.network.board(0);
            assert_ne!(board.output(RUN).level, board.output(ERR).level);
            rig.network.run_for(Time::from_ms(50));
        }
    }
}

#[test]
fn err_flashes_once_while_the_error_counters_warn() {
    let mut rig = rig_with(settings(0x40, BitRate::Kbit500).with_heartbeat_ms(100));
    rig.collect(Time::from_ms(20));
    // No other node acknowledges: the transmit error counter rises to 128 and stays there.
    rig.network.adapter_mut(rig.master).close();
    rig.network.run_for(Time::from_ms(300));
    assert_eq!(pattern(&mut rig, ERR), "####....................".repeat(2));
}
