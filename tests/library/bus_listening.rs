//! Automatic bit-rate detection (CiA 305, table 0, index 9): how a node listens, and its silence until it knows the
//! rate.

use canopen_node::{BitRate, BitRateSetting, BitRates, BusEvent, Device, Settings, nmt::State};
use testkit::{
    flash::BoardFlash,
    frames::{self, SILENCE},
    node_rig::{ADDRESS, NodeRig, defaults, device},
};

const KBIT_PER_S: [u16; 8] = [1000, 800, 500, 250, 125, 50, 20, 10];

fn with_automatic(device: Device) -> Device {
    device.with_bit_rates(device.bit_rates.with_automatic())
}

/// A board that starts at 1 Mbit/s and offers automatic detection.
fn fixed() -> NodeRig {
    NodeRig::with_device(
        with_automatic(device(ADDRESS)).with_defaults(defaults(0x40)),
        BoardFlash::blank(0),
        0,
    )
}

fn listening_with(device: Device, settings: Settings, clock_at_start: u32) -> NodeRig {
    let settings = settings.with_bit_rate(BitRateSetting::Automatic);
    NodeRig::with_device(
        with_automatic(device).with_defaults(settings),
        BoardFlash::blank(0),
        clock_at_start,
    )
}

/// A board that detects the bit rate from power-on, with an empty timeline.
fn listening() -> NodeRig {
    let mut board = listening_with(device(ADDRESS), defaults(0x40), 0);
    assert_eq!(board.timeline(), ["0 ms listen at 1000 kbit/s"]);
    board
}

#[test]
fn automatic_detection_is_kept_by_17_and_begins_at_the_next_power_on() {
    let mut board = fixed();
    board.configure("13 00 09");
    assert_eq!(board.lss("17"), ["17 00"]);
    assert!(!board.node.is_listening(), "it is only stored");
    board.timeline();
    assert_eq!(board.power_cycle(), SILENCE);
    assert_eq!(board.timeline(), ["0 ms listen at 1000 kbit/s"]);
    assert_eq!(board.stored().map(|s| s.bit_rate), Some(BitRateSetting::Automatic));
}

#[test]
fn activation_listens_after_one_delay_and_sends_after_two_at_the_earliest() {
    for (heard_at_ms, expected) in [
        (150, &["100 ms listen at 1000 kbit/s", "150 ms 1000 kbit/s"]),
        (300, &["100 ms listen at 1000 kbit/s", "300 ms 1000 kbit/s"]),
    ] {
        let mut board = fixed();
        board.configure("13 00 09");
        board.timeline();
        board.lss("15 64 00");
        board.pass_ms(heard_at_ms);
        assert_eq!(board.receive(&frames::stranger()), SILENCE);
        board.pass_ms(1000 - heard_at_ms);
        assert_eq!(board.timeline(), [&["0 ms drop all"][..], expected].concat());
        assert_eq!(board.lss("5E"), ["5E 40"], "still in configuration state");
    }
}

#[test]
fn in_the_second_delay_the_search_restarts_at_the_fastest_after_silence() {
    let mut board = fixed();
    board.configure("13 00 09");
    board.timeline();
    board.lss("15 88 13");
    board.pass_ms(6_000);
    board.see(BusEvent::Error);
    board.pass_ms(6_000);
    let expected = [
        "0 ms drop all",
        "5000 ms listen at 1000 kbit/s",
        "6000 ms listen at 800 kbit/s",
        "6040 ms listen at 800 kbit/s",
        "7140 ms listen at 1000 kbit/s",
    ];
    assert_eq!(board.timeline(), expected);
}

#[test]
fn activating_automatic_detection_again_keeps_the_rate_found() {
    let mut board = listening();
    board.see(BusEvent::Error);
    board.receive(&frames::stranger());
    board.lss("04 01");
    board.timeline();
    board.lss("15 0A 00");
    board.pass_ms(100);
    assert_eq!(board.timeline(), ["0 ms drop all"]);
    assert_eq!(board.bit_rate(), BitRate::Kbit800);
}

#[test]
fn a_fixed_rate_ends_automatic_detection() {
    let mut board = listening();
    board.receive(&frames::stranger());
    board.configure("13 00 04, 17, 15 00 00");
    assert_eq!(board.bit_rate(), BitRate::Kbit125);
    assert_eq!(board.power_cycle(), ["740: 00"]);
    assert_eq!(board.bit_rate(), BitRate::Kbit125);
}

#[test]
fn nothing_is_ever_sent_while_listening() {
    let mut board = listening_with(device(ADDRESS).with_heartbeat_ms(100), defaults(0x40), 0);
    for kbit_per_s in [800, 500, 250, 125, 50, 20, 10, 1000] {
        assert_eq!(board.see(BusEvent::Error), SILENCE);
        assert_eq!(board.pass_ms(1_000), SILENCE, "no heartbeat");
        assert_eq!(board.see(BusEvent::BusOff), SILENCE);
        assert_eq!(board.bit_rate().kbit_per_s(), kbit_per_s, "only an error leads on");
        assert_eq!(board.node.nmt_state(), State::Initialisation);
    }
    assert!(board.timeline().iter().all(|line| line.contains("listen")));
}

#[test]
fn the_first_valid_frame_decides_and_is_not_obeyed() {
    for (steps, kbit_per_s) in KBIT_PER_S.into_iter().enumerate() {
        for first in [frames::stranger(), frames::request("04 01"), frames::command("01 00")] {
            let mut board = listening();
            for _ in 0..steps {
                board.see(BusEvent::Error);
            }
            board.timeline();
            assert_eq!(board.receive(&first), ["740: 00"], "the boot-up");
            let rate = format!("0 ms {kbit_per_s} kbit/s");
            assert_eq!(board.timeline(), [&rate, "0 ms 740: 00"]);
            assert!(!board.is_in_configuration_state());
            assert_eq!(board.node.nmt_state(), State::PreOperational);
        }
    }
}

#[test]
fn a_rate_once_found_is_kept_through_errors_and_bus_off() {
    let mut board = listening();
    board.see(BusEvent::Error);
    board.receive(&frames::stranger());
    for event in [BusEvent::Error, BusEvent::BusOff] {
        board.see(event);
        board.pass_ms(60_000);
        assert_eq!(board.bit_rate(), BitRate::Kbit800, "{event:?}");
        assert!(!board.node.is_listening(), "{event:?}");
    }
}

#[test]
fn form_errors_keep_the_rate_for_40_ms() {
    let mut board = listening();
    for _ in 0..40 {
        board.see(BusEvent::FormError);
        board.pass_ms(1);
    }
    assert_eq!(board.timeline(), ["40 ms listen at 800 kbit/s"]);
}

#[test]
fn rates_that_the_clock_cannot_produce_are_left_out() {
    let device = device(ADDRESS).with_bit_rates(BitRates::possible(42_000_000));
    assert!(!device.bit_rates.contains(BitRate::Kbit800));
    let mut board = listening_with(device, defaults(0x40), 0);
    board.see(BusEvent::Error);
    assert_eq!(board.bit_rate(), BitRate::Kbit500);
}

#[test]
fn after_1100_ms_of_silence_listening_starts_again_at_the_fastest_rate() {
    let mut board = listening();
    for _ in 0..3 {
        board.see(BusEvent::Error);
    }
    // An error ends a stay after 40 ms; the next one waits.
    board.pass_us(1_139_999);
    assert_eq!(board.bit_rate(), BitRate::Kbit250);
    board.pass_us(1);
    assert_eq!(board.bit_rate(), BitRate::Kbit1000);
    board.see(BusEvent::Error);
    board.pass_us(1_139_999);
    assert_eq!(board.bit_rate(), BitRate::Kbit800, "the error restarted the time");
}

#[test]
fn on_a_silent_bus_a_node_listens_at_the_fastest_rate_forever() {
    for clock_at_start in [0, u32::MAX - 40_000_000] {
        let mut board = listening_with(device(ADDRESS), defaults(0x40), clock_at_start);
        board.timeline();
        assert_eq!(board.pass_ms(10 * 60_000), SILENCE);
        assert_eq!(board.timeline(), SILENCE, "nor does it change the controller");
        assert_eq!(board.receive(&frames::stranger()), ["740: 00"]);
    }
}

#[test]
fn a_node_without_a_node_id_detects_the_rate_and_is_found_by_the_master() {
    let mut board = listening_with(device(ADDRESS), defaults(0xFF), 0);
    board.see(BusEvent::Error);
    assert_eq!(board.receive(&frames::request("4C")), SILENCE, "it did not receive this one");
    assert_eq!(board.bit_rate(), BitRate::Kbit800);
    assert_eq!(board.lss("4C"), ["50"]);
}

/// A board with a heartbeat every second that detects its bit rate since an activation.
fn activated() -> NodeRig {
    let device = with_automatic(device(ADDRESS)).with_heartbeat_ms(1_000);
    let mut board = NodeRig::of(device.with_defaults(defaults(0x40)));
    board.configure("13 00 09, 15 00 00");
    assert!(board.node.is_listening());
    board
}

#[test]
fn a_node_that_detects_its_bit_rate_is_silent_then_sends_its_heartbeat() {
    let mut board = activated();
    board.report(BusEvent::Overrun);
    assert_eq!(board.pass_ms(20_000), SILENCE);
    let sent = ["0C0: 10 81 11 00 00 00 00 00", "0C0: 00 00 00 00 00 00 00 00", "740: 7F"];
    assert_eq!(board.see(BusEvent::Received), sent);
    assert_eq!(board.pass_us(999_999), SILENCE);
    assert_eq!(board.pass_us(1), ["740: 7F"]);
}

#[test]
fn a_node_that_listened_for_hours_goes_on_with_its_heartbeat_at_once() {
    // 35.8 minutes or more after the last heartbeat, half a turn of the clock, past instants look like future ones.
    for minutes in [30, 36, 60, 71, 120] {
        let mut board = activated();
        for _ in 0..3 * minutes {
            board.see(BusEvent::Error);
            assert_eq!(board.pass_ms(20_000), SILENCE);
        }
        assert_eq!(board.see(BusEvent::Received), ["740: 7F"], "after {minutes} minutes");
        assert_eq!(board.pass_ms(1_000), ["740: 7F"]);
    }
}
