//! Bit-rate supervision of a guest: taking part at a rate found by listening, visits home, and LSS meanwhile.

use canopen_node::{
    BitRate, BitRateSetting,
    BusEvent::{Acknowledged, BusOff, Error, FormError, HeldDominant, Received},
    NodeId, lss, nmt,
};
use testkit::{
    frames::{self, SILENCE},
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::Client,
    supervised::{TURN_US, guest, searching, unproven, unproven_at},
};

/// Emergency FF10h with 1000 kbit/s in use and 125 kbit/s at home; and its end.
const AWAY: &str = "0C0: 10 FF 11 E8 03 7D 00 00";
const HOME_AGAIN: &str = "0C0: 00 00 00 E8 03 7D 00 00";

/// The active and the pending bit rate of LSS, in kbit/s; 0 is automatic detection.
fn lss_rates(board: &NodeRig) -> [u16; 2] {
    let node = &board.node;
    [node.active_bit_rate(), node.lss().pending_bit_rate()].map(|setting| match setting {
        BitRateSetting::Fixed(rate) => rate.kbit_per_s(),
        BitRateSetting::Automatic => 0,
    })
}

/// The home rate and the one in use, in kbit/s, and the number of rescues, from object 2000h.
fn objects(board: &mut NodeRig) -> [u32; 3] {
    [5, 6, 7].map(|sub_index| board.number(0x2000, sub_index))
}

/// Sends a guest home, where the bus is quiet.
fn send_home(board: &mut NodeRig) {
    board.see(Error);
    board.see(Error);
    board.pass_ms(2_000);
    assert_eq!(board.bit_rate(), BitRate::Kbit125);
}

/// The times in milliseconds at which a guest begins its visits while someone is heard at its rate.
fn visits(board: &mut NodeRig, ms: u64) -> Vec<u64> {
    let begin = board.now();
    let mut visits = Vec::new();
    while board.now() < begin + ms * 1000 {
        let left = begin + ms * 1000 - board.now();
        board.pass_us(board.us_to_deadline().map_or(left, |us| us.min(left)));
        if board.node.is_listening() {
            match board.bit_rate() {
                BitRate::Kbit125 => visits.push((board.now() - begin) / 1000),
                _ => _ = board.see(Received),
            }
        }
    }
    visits
}

#[test]
fn the_first_valid_frame_elsewhere_decides_and_is_not_obeyed() {
    let mut board = unproven_at(BitRate::Kbit125, 0);
    board.see(Error);
    board.is_acknowledged = true;
    board.timeline();
    board.receive(&frames::command("01 00"));
    let away = format!("0 ms {AWAY}");
    let expected = ["0 ms 1000 kbit/s", "0 ms resume", "0 ms 740: 00", &away];
    assert_eq!(board.timeline(), expected);
    assert_eq!(board.node.nmt_state(), nmt::State::PreOperational);
    board.lss("04 01");
    assert_eq!(board.lss("5E"), ["5E 40"], "the second is");
    let mut board = searching();
    board.see(Error);
    board.receive(&frames::stranger());
    assert_eq!((board.bit_rate(), board.node.is_listening()), (BitRate::Kbit800, false));
}

#[test]
fn the_rate_found_is_active_and_the_stored_one_pending() {
    let mut board = guest();
    assert_eq!((lss_rates(&board), objects(&mut board)), ([1000, 125], [125, 1000, 1]));
    board.configure("11 07");
    assert_eq!(board.lss("17"), ["17 00"]);
    let stored = board.stored().expect("settings");
    assert_eq!((stored.node_id, stored.bit_rate), (NodeId::new(7), BitRate::Kbit125.into()));
    send_home(&mut board);
    assert_eq!((lss_rates(&board), objects(&mut board)), ([125, 125], [125, 125, 1]));
}

#[test]
fn a_guest_stores_and_activates_the_rate_that_13_or_15_has_set() {
    for (requests, active, stored) in [
        (&["13 00 02", "17"][..], BitRate::Kbit1000, BitRate::Kbit500),
        (&["13 00 02", "15 00 00", "17"], BitRate::Kbit500, BitRate::Kbit500),
        (&["15 00 00", "17"], BitRate::Kbit1000, BitRate::Kbit1000),
        (&["13 00 05", "17"], BitRate::Kbit1000, BitRate::Kbit125),
    ] {
        let mut board = guest();
        board.lss("04 01");
        requests.iter().for_each(|request| _ = board.lss(request));
        assert_eq!(board.bit_rate(), active, "{requests:?}");
        assert_eq!(board.stored().map(|s| s.bit_rate), Some(stored.into()), "{requests:?}");
    }
}

#[test]
fn activation_without_configuration_makes_the_rate_found_a_proven_home() {
    let mut board = guest();
    board.lss("04 01");
    board.timeline();
    board.lss("15 0A 00");
    board.pass_ms(20);
    let end = format!("20 ms {HOME_AGAIN}");
    assert_eq!(board.timeline(), ["0 ms stop", "20 ms resume", "20 ms receives", &end]);
    assert_eq!((lss_rates(&board), objects(&mut board)), ([1000, 1000], [1000, 1000, 1]));
    board.timeline();
    for _ in 0..100 {
        board.see(Error);
        board.pass_ms(1_000);
    }
    assert_eq!(board.timeline(), SILENCE);
}

#[test]
fn a_guest_that_is_switched_home_is_home() {
    let mut board = guest();
    board.configure("13 00 04, 15 00 00");
    assert_eq!(objects(&mut board), [125, 125, 1]);
    assert_eq!(board.number(0x1001, 0), 0);
}

#[test]
fn a_guest_leaves_at_the_second_error_without_a_valid_frame() {
    for proof in [Received, Acknowledged] {
        let mut board = guest();
        for error in [Error, FormError].into_iter().cycle().take(20) {
            board.see(error);
            board.see(BusOff);
            board.see(proof);
        }
        assert_eq!(board.timeline(), SILENCE, "{proof:?}");
        board.see(FormError);
        board.pass_ms(1_000);
        board.see(Error);
        assert_eq!(board.timeline(), ["1000 ms listen at 125 kbit/s"]);
        assert_eq!(board.node.lss().state(), lss::State::Waiting);
    }
}

#[test]
fn a_guest_leaves_when_a_frame_finds_no_acknowledge_for_100_ms() {
    for request in [frames::request("5E"), testkit::sdo::request(0x40, "40 00 10 00")] {
        let mut board = guest();
        board.lss("04 01");
        board.timeline();
        board.is_acknowledged = false;
        board.receive(&request);
        board.pass_us(99_999);
        board.see(Received);
        board.receive(&request);
        board.pass_us(99_999);
        assert_eq!(board.timeline().len(), 2, "without a pause: {request:?}");
        board.pass_us(1);
        assert_eq!(board.timeline(), ["0.001 ms listen at 125 kbit/s"], "{request:?}");
    }
}

#[test]
fn a_guest_that_leaves_listens_at_home_and_then_where_it_was() {
    let mut board = guest();
    board.see(Error);
    board.see(Error);
    board.see(FormError);
    board.pass_ms(60_000);
    let expected = [
        "0 ms listen at 125 kbit/s",
        "49.44 ms listen at 1000 kbit/s",
        "1149.44 ms listen at 125 kbit/s",
        "1198.88 ms 125 kbit/s",
        "1198.88 ms resume",
        &format!("1198.88 ms {HOME_AGAIN}"),
        "1198.88 ms receives",
    ];
    assert_eq!(board.timeline(), expected);
}

#[test]
fn a_guest_visits_home_2_4_8_to_64_s_after_joining() {
    let mut board = guest();
    let visits = visits(&mut board, 250_000);
    let gaps: Vec<_> = visits.windows(2).map(|pair| (pair[1] - pair[0]) / 1000).collect();
    assert_eq!(visits[0], 2_014, "shifted by the serial number");
    assert_eq!(gaps, [4, 8, 16, 32, 64, 64]);
}

#[test]
fn a_request_of_a_master_keeps_a_guest_for_64_s() {
    for frame in [
        frames::request("04 00"),
        frames::command("01 00"),
        testkit::sdo::request(0x40, "40 00 10 00"),
        canopen_node::Frame::new(0x080, &[]).expect("SYNC"),
    ] {
        let mut board = guest();
        board.pass_ms(1_000);
        board.receive(&frame);
        assert_eq!(visits(&mut board, 70_000), [64_014], "{frame:?}");
    }
    let mut board = guest();
    board.pass_ms(1_000);
    board.receive(&frames::stranger());
    assert_eq!(visits(&mut board, 3_000), [1_014], "another frame does not");
}

#[test]
fn guests_visit_home_together_2_s_after_the_last_one_has_joined() {
    for (code, first_visit) in [("10 FF", 2_014), ("20 81", 514)] {
        let mut board = guest();
        board.pass_ms(1_500);
        board.receive(&frames::of_node(&format!("0C1: {code} 11 E8 03 7D 00 00")));
        assert_eq!(visits(&mut board, 3_000), [first_visit], "emergency {code}");
    }
}

/// A guest with a heartbeat that has just begun a visit.
fn visitor() -> NodeRig {
    let mut board = unproven_at(BitRate::Kbit125, 1_000);
    board.see(Error);
    board.is_acknowledged = true;
    board.see(Received);
    board.pass_us(2_014_000);
    assert!(board.node.is_listening());
    board.is_acknowledged = false;
    board.timeline();
    board
}

#[test]
fn a_visitor_listens_then_takes_part_for_two_heartbeats_and_returns() {
    let mut board = visitor();
    board.pass_ms(60);
    let expected = [
        "49.44 ms 125 kbit/s",
        "49.44 ms resume",
        "49.44 ms 740: 7F",
        "50.72 ms listen at 1000 kbit/s",
    ];
    assert_eq!(board.timeline(), expected);
    assert_eq!(board.see(Received), ["740: 7F"], "a guest again");
    assert_eq!(objects(&mut board), [125, 1000, 1], "no new rescue");
}

#[test]
fn errors_send_a_visitor_back() {
    for (events, us, expected) in [
        (&[Error][..], 1, &["0 ms listen at 1000 kbit/s"][..]),
        (&[FormError], 1, &[]),
        (&[Error], TURN_US, &[]),
        (&[Error, Error], TURN_US, &["0 ms listen at 1000 kbit/s"]),
    ] {
        let mut board = visitor();
        board.pass_us(us);
        board.timeline();
        events.iter().for_each(|&event| _ = board.see(event));
        assert_eq!(board.timeline(), expected, "{events:?} after {us} us");
    }
}

#[test]
fn a_visitor_that_is_heard_or_hears_stays_home() {
    for (us, proof) in [(1, Received), (TURN_US, Received), (TURN_US, Acknowledged)] {
        let mut board = visitor();
        board.pass_us(us);
        board.is_acknowledged = true;
        assert!(board.see(proof).0.iter().any(|frame| frames::text(frame) == HOME_AGAIN));
        assert_eq!(objects(&mut board), [125, 125, 1]);
        board.timeline();
        for _ in 0..100 {
            board.see(Error);
        }
        assert!(!board.node.is_listening(), "home is proven: {proof:?}");
    }
}

#[test]
fn a_visitor_that_hears_nothing_at_either_rate_stays_home() {
    let mut board = visitor();
    board.pass_us(1_280 + 1_100_000 + 2 * TURN_US);
    assert_eq!((board.bit_rate(), board.node.is_listening()), (BitRate::Kbit125, false));
    let mut board = visitor();
    board.see(HeldDominant);
    assert_eq!((board.bit_rate(), board.node.is_listening()), (BitRate::Kbit125, false));
}

#[test]
fn ff10_reports_a_rescue_and_its_end_and_the_history_keeps_the_rate() {
    let mut board = unproven();
    board.see(Error);
    board.is_acknowledged = true;
    assert_eq!(board.see(Received), ["740: 00", AWAY]);
    assert_eq!(board.number(0x1001, 0), 0x11);
    assert_eq!(board.number(0x1003, 1), 0x03E8_FF10);
    board.see(Error);
    board.see(Error);
    assert_eq!(board.pass_ms(2_000), [HOME_AGAIN]);
    assert_eq!(board.number(0x1001, 0), 0);
}

#[test]
fn a_rate_found_again_is_no_new_rescue_and_another_one_is() {
    let mut board = guest();
    for (errors, message, rescues) in
        [(0, None, [125, 1000, 1]), (1, Some("0C0: 10 FF 11 20 03 7D 00 00"), [125, 800, 2])]
    {
        board.see(Error);
        board.see(Error);
        board.pass_us(TURN_US);
        (0..errors).for_each(|_| _ = board.see(Error));
        let sent = board.see(Received);
        assert_eq!(sent.0.first().map(frames::text).as_deref(), message);
        assert_eq!(objects(&mut board), rescues);
    }
}

/// A board that offers automatic detection, whose frames find no acknowledge, with this bit rate.
fn with_automatic(bit_rate: BitRateSetting) -> NodeRig {
    let device = device(ADDRESS);
    let bit_rates = device.bit_rates.with_automatic();
    let device = device.with_bit_rates(bit_rates).with_rescue(true);
    let settings = defaults(0x40).with_bit_rate(bit_rate);
    let mut board = NodeRig::of(device.with_defaults(settings));
    board.is_acknowledged = false;
    board.power_cycle();
    board
}

#[test]
fn a_guest_commanded_to_detect_its_rate_is_no_longer_a_guest() {
    let mut board = with_automatic(BitRate::Kbit125.into());
    board.see(Error);
    board.is_acknowledged = true;
    board.see(Received);
    board.configure("13 00 09, 15 00 00");
    assert!(board.node.is_listening());
    assert_eq!(board.see(Received), [HOME_AGAIN]);
    assert_eq!(objects(&mut board), [1000, 1000, 1]);
    assert_eq!(board.number(0x1001, 0), 0);
}

#[test]
fn a_detected_rate_is_proven() {
    let mut board = with_automatic(BitRateSetting::Automatic);
    for _ in 0..4 {
        board.see(Error);
    }
    board.is_acknowledged = true;
    board.see(Received);
    board.timeline();
    for _ in 0..100 {
        board.see(Error);
    }
    assert_eq!(board.timeline(), SILENCE);
    assert_eq!((lss_rates(&board), objects(&mut board)), ([0, 0], [125, 125, 0]));
}
