//! Bit-rate supervision at the home rate: the evidence for a look, and the times in which the node withholds its
//! frames.

use lss_slave::{
    BitRate,
    BusEvent::{
        self, Acknowledged, BusOff, Error, ErrorPassive, FormError, HeldDominant, Received,
    },
    Instant,
};
use testkit::{
    flash::BoardFlash,
    frames::{SILENCE, request},
    node_rig::{ADDRESS, NodeRig, defaults, device},
    supervised::{doubt, powered_on, proven, switched, unproven},
};

#[test]
fn an_unproven_home_rate_is_doubted_at_the_first_error() {
    for error in [Error, FormError] {
        let mut board = unproven();
        board.see(error);
        assert_eq!(board.timeline(), ["0 ms listen at 1000 kbit/s"], "{error:?}");
    }
}

#[test]
fn a_proven_home_rate_is_doubted_at_the_third_error_after_a_second() {
    for proof in [Received, Acknowledged] {
        let mut board = unproven();
        board.see(proof);
        board.see(Error);
        board.pass_ms(1_000);
        board.see(Error);
        assert!(!board.node.is_listening(), "two are not enough: {proof:?}");
        board.see(Error);
        assert!(board.node.is_listening(), "three are: {proof:?}");
    }
    let mut board = proven();
    for _ in 0..100 {
        board.see(Error);
    }
    board.pass_us(999_999);
    board.see(Error);
    assert_eq!(board.timeline(), SILENCE, "many in less than a second are not enough");
    board.pass_us(1);
    board.see(FormError);
    assert_eq!(board.timeline(), ["0.001 ms listen at 1000 kbit/s"]);
}

#[test]
fn nothing_is_due_after_the_acknowledge_of_an_answer_in_service() {
    let mut board = proven();
    board.lss("04 01");
    let now = Instant::from_micros(board.now() as u32);
    assert!(board.node.handle_frame(&request("5E"), now).is_some());
    assert_eq!(board.us_to_deadline(), Some(100_000), "the repetition of the answer ends");
    board.node.handle_bus(Acknowledged, now);
    assert!(!board.node.is_due(now));
    assert_eq!(board.us_to_deadline(), None);
    board.node.handle_bus(Error, now);
    assert!(board.node.is_due(now), "a disturbed node looks at its errors");
}

#[test]
fn errors_two_and_a_half_seconds_apart_do_not_add_up() {
    let mut board = proven();
    for _ in 0..20 {
        board.see(Error);
        board.pass_us(2_500_000);
    }
    assert_eq!(board.timeline(), SILENCE);
    for _ in 0..3 {
        board.see(Error);
        board.pass_us(2_499_999);
    }
    assert!(!board.timeline().is_empty(), "a little closer they do");
}

#[test]
fn a_valid_frame_or_an_acknowledge_clears_the_errors() {
    for proof in [Received, Acknowledged] {
        let mut board = unproven();
        board.see(proof);
        for _ in 0..100 {
            board.see(Error);
            board.pass_ms(600);
            board.see(Error);
            board.see(Error);
            board.pass_ms(600);
            board.see(proof);
        }
        assert_eq!(board.timeline(), SILENCE, "{proof:?}");
    }
}

#[test]
fn bus_off_and_error_passive_are_no_evidence_of_another_rate() {
    let mut board = unproven();
    for _ in 0..100 {
        board.see(BusOff);
        board.see(ErrorPassive);
        board.pass_ms(100);
        assert!(!board.node.is_listening());
    }
}

#[test]
fn for_30_s_after_a_switch_the_new_rate_counts_alone() {
    let mut board = switched();
    for _ in 0..300 {
        board.see(Error);
        board.see(FormError);
        board.pass_us(99_999);
        board.see(Error);
        assert_eq!(board.timeline(), SILENCE);
        board.pass_us(1);
    }
    board.see(Error);
    assert!(board.node.is_listening(), "after them it may be wrong");
}

#[test]
fn the_30_s_begin_at_the_end_of_the_second_switch_delay() {
    for d_ms in [0_u16, 1_000, 65_535] {
        let mut board = powered_on(BitRate::Kbit250, 0);
        board.lss("04 01");
        board.lss("13 00 06");
        let [low, high] = d_ms.to_le_bytes();
        board.lss(&format!("15 {low:02X} {high:02X}"));
        board.pass_ms(2 * u64::from(d_ms) + 29_999);
        for _ in 0..9 {
            board.see(Error);
        }
        assert!(!board.node.is_listening(), "{d_ms} ms");
        board.pass_ms(1);
        board.see(Error);
        assert!(board.node.is_listening(), "{d_ms} ms");
    }
}

#[test]
fn after_a_switch_the_rate_before_it_is_listened_to_first() {
    let mut board = switched();
    board.pass_ms(30_000);
    board.see(Error);
    assert_eq!(board.timeline(), ["30000 ms listen at 250 kbit/s"]);
    board.pass_ms(10_000);
    board.timeline();
    board.see(Error);
    assert_eq!(board.timeline(), ["0 ms listen at 1000 kbit/s"], "once");

    let mut board = switched();
    board.see(Received);
    board.pass_ms(30_000);
    board.timeline();
    doubt(&mut board);
    assert_eq!(board.timeline(), ["1000 ms listen at 1000 kbit/s"], "not if the new one works");
}

#[test]
fn in_the_switch_delays_neither_errors_nor_bus_off_count() {
    for event in [Error, FormError, ErrorPassive, BusOff] {
        let mut board = powered_on(BitRate::Kbit1000, 0);
        board.lss("04 01");
        board.lss("13 00 04");
        board.timeline();
        board.lss("15 64 00");
        for _ in 0..19 {
            board.see(event);
            board.pass_ms(10);
        }
        board.pass_ms(10);
        let expected = ["0 ms stop", "100 ms 125 kbit/s", "200 ms resume"];
        assert_eq!(board.timeline(), expected, "{event:?}");
    }
}

/// A board at `home` that sends a heartbeat every 10 ms, no longer acknowledged, and has just been disturbed.
fn disturbed(home: BitRate, by: BusEvent) -> NodeRig {
    let mut board = powered_on(home, 10);
    board.is_acknowledged = false;
    board.timeline();
    board.see(by);
    board
}

#[test]
fn bus_off_restarts_the_controller_at_home_and_frames_wait_50_ms() {
    let mut board = disturbed(BitRate::Kbit125, BusOff);
    board.pass_ms(60);
    let expected = ["0 ms 125 kbit/s", "0 ms resume", "50 ms 740: 7F", "60 ms 740: 7F"];
    assert_eq!(board.timeline(), expected);
}

#[test]
fn on_a_slow_bus_frames_wait_1408_bits_after_bus_off() {
    for (home, us) in [(BitRate::Kbit20, 70_400), (BitRate::Kbit10, 140_800)] {
        let mut board = disturbed(home, BusOff);
        board.pass_us(1_000);
        board.see(Error);
        assert_eq!(board.pass_us(us - 1_001), SILENCE, "an error does not make it shorter");
        assert_eq!(board.pass_us(1), ["740: 7F"]);
    }
}

#[test]
fn an_unacknowledged_frame_pauses_20_ms_every_100_ms() {
    let mut board = unproven();
    board.pass_ms(240);
    let expected = [
        "100 ms stop",
        "100 ms resume",
        "120 ms 740: 00",
        "220 ms stop",
        "220 ms resume",
        "240 ms 740: 00",
    ];
    assert_eq!(board.timeline(), expected, "so that a slower node can join the bus");
    board.see(Acknowledged);
    board.pass_ms(1_000);
    assert_eq!(board.timeline(), SILENCE);
}

#[test]
fn an_unacknowledged_answer_pauses_without_another_event() {
    let mut board = proven();
    board.lss("04 01");
    board.is_acknowledged = false;
    assert_eq!(board.lss("5E"), ["5E 40"]);
    board.pass_ms(1_000);
    assert_eq!(board.timeline()[1..], ["100 ms stop", "100 ms resume"]);
}

#[test]
fn a_request_in_the_pause_of_the_boot_up_ends_it_and_is_answered() {
    let mut board = unproven();
    board.pass_ms(110);
    board.is_acknowledged = true;
    assert_eq!(board.sdo("40 18 10 04"), ["740: 00", "5C0: 43 18 10 04 EF BE AD DE"]);
}

#[test]
fn a_receiver_that_is_error_passive_drops_its_frames_and_waits_50_ms() {
    for home in [BitRate::Kbit1000, BitRate::Kbit10] {
        let mut board = disturbed(home, ErrorPassive);
        board.pass_ms(20);
        board.see(ErrorPassive);
        board.pass_ms(30);
        assert_eq!(board.timeline(), ["0 ms stop", "0 ms resume", "50 ms 740: 7F"]);
    }
}

#[test]
fn frames_wait_50_ms_after_the_latest_error() {
    for (by, error) in [(BusOff, Error), (ErrorPassive, FormError)] {
        let mut board = disturbed(BitRate::Kbit125, by);
        board.see(Received);
        board.see(by);
        for _ in 0..20 {
            assert_eq!(board.pass_us(40_000), SILENCE);
            board.see(error);
        }
        assert_eq!(board.pass_us(49_999), SILENCE, "{by:?}");
        assert_eq!(board.pass_us(1), ["740: 7F"], "{by:?}");
    }
}

#[test]
fn a_bus_that_is_held_dominant_does_not_extend_the_wait() {
    for by in [BusOff, ErrorPassive] {
        let mut board = disturbed(BitRate::Kbit125, by);
        board.pass_us(40_000);
        board.see(HeldDominant);
        assert_eq!(board.pass_us(9_999), SILENCE, "{by:?}");
        assert_eq!(board.pass_us(1), ["740: 7F"], "{by:?}");
    }
}

#[test]
fn after_a_fruitless_search_errors_do_not_extend_the_wait() {
    let mut board = powered_on(BitRate::Kbit125, 10);
    board.is_acknowledged = false;
    doubt(&mut board);
    board.see(HeldDominant);
    assert!(!board.node.is_listening(), "the search has ended");
    for is_extended in [false, true] {
        board.see(ErrorPassive);
        board.pass_us(40_000);
        board.see(Error);
        assert_eq!(board.pass_us(9_999), SILENCE);
        assert_eq!(board.pass_us(1).0.is_empty(), is_extended);
        board.see(Received);
    }
}

#[test]
fn a_valid_frame_or_an_acknowledge_ends_the_wait() {
    for by in [BusOff, ErrorPassive] {
        for proof in [Received, Acknowledged] {
            let mut board = disturbed(BitRate::Kbit125, by);
            assert_eq!(board.pass_ms(1), SILENCE);
            assert_eq!(board.see(proof), ["740: 7F"], "{by:?}, {proof:?}");
        }
        let mut board = disturbed(BitRate::Kbit125, by);
        board.lss("04 01");
        assert_eq!(board.lss("5E"), ["5E 40"], "a request is answered at once");
    }
}

#[test]
fn a_node_without_supervision_never_looks_elsewhere_nor_waits() {
    let settings = defaults(0x40).with_heartbeat_ms(100);
    let device = device(ADDRESS).with_rescue(false);
    let mut board = NodeRig::with_device(device.with_defaults(settings), BoardFlash::blank(0), 0);
    board.is_acknowledged = false;
    for _ in 0..1_000 {
        for event in [BusOff, Error, FormError, ErrorPassive, Error] {
            board.see(event);
        }
        assert_eq!(board.pass_ms(100), ["740: 7F"]);
    }
    assert_eq!(board.bit_rate(), BitRate::Kbit1000);
}
