//! Bit-rate supervision of a guest: taking part at a rate found by listening, its silence, and LSS meanwhile.

use canopen_node::{
    BitRate, BitRateSetting,
    BusEvent::{Acknowledged, BusOff, Error, FormError, Overrun, Received},
    NodeId,
    emergency::Fault,
    lss, nmt,
};
use testkit::{
    frames::{self, SILENCE},
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::Client,
    supervised::{TURN_US, asked_guest, guest, searching, unproven_at},
};

/// Emergency FF10h with 1000 kbit/s in use and 125 kbit/s at home; and its end.
const AWAY: &str = "0C0: 10 FF 11 E8 03 7D 00 00";
/// The answer to `5E` of node 40h.
const ANSWER: &str = "7E4: 5E 40 00 00 00 00 00 00";
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

/// The time for which a guest stays that hears nothing, in milliseconds.
fn silence_ms(board: &mut NodeRig) -> u64 {
    let begin = board.now();
    while !board.node.is_listening() {
        board.pass_us(board.us_to_deadline().expect("the end of the silence"));
    }
    assert_eq!(board.bit_rate(), BitRate::Kbit125, "home first");
    (board.now() - begin) / 1000
}

#[test]
fn the_first_valid_frame_elsewhere_decides_and_is_not_obeyed() {
    let mut board = unproven_at(BitRate::Kbit125, 0);
    board.see(Error);
    board.is_acknowledged = true;
    board.timeline();
    board.receive(&frames::command("01 00"));
    assert_eq!(board.timeline(), ["0 ms 1000 kbit/s"]);
    assert_eq!(board.node.nmt_state(), nmt::State::PreOperational);
    board.lss("04 01");
    assert_eq!(board.lss("5E").0.first().map(frames::text).as_deref(), Some(ANSWER), "the second");
    let mut board = searching();
    board.see(Error);
    board.receive(&frames::stranger());
    assert_eq!((board.bit_rate(), board.node.is_listening()), (BitRate::Kbit800, false));
}

#[test]
fn the_rate_found_is_active_and_the_stored_one_pending() {
    let mut board = asked_guest();
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
        let mut board = asked_guest();
        board.lss("04 01");
        requests.iter().for_each(|request| _ = board.lss(request));
        assert_eq!(board.bit_rate(), active, "{requests:?}");
        assert_eq!(board.stored().map(|s| s.bit_rate), Some(stored.into()), "{requests:?}");
    }
}

#[test]
fn a_guest_switches_after_a_delay_that_is_longer_than_its_stay() {
    let mut board = asked_guest();
    board.configure("13 00 02, 15 FF FF");
    board.timeline();
    board.pass_ms(65_000);
    board.see(Error);
    board.pass_ms(535);
    assert_eq!(board.timeline(), ["65535 ms 500 kbit/s"]);
}

#[test]
fn activation_without_configuration_makes_the_rate_found_a_proven_home() {
    let mut board = asked_guest();
    board.lss("04 01");
    board.timeline();
    board.lss("15 0A 00");
    board.pass_ms(20);
    let end = format!("20 ms {HOME_AGAIN}");
    assert_eq!(board.timeline(), ["0 ms drop all", "20 ms receives", &end]);
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
    let mut board = asked_guest();
    board.configure("13 00 04, 15 00 00");
    assert_eq!(objects(&mut board), [125, 125, 1]);
    assert_eq!(board.number(0x1001, 0), 0);
}

#[test]
fn a_guest_leaves_at_the_second_error_without_a_valid_frame() {
    for proof in [Received, Acknowledged] {
        let mut board = asked_guest();
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
        let mut board = asked_guest();
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
    let mut board = asked_guest();
    board.see(Error);
    board.see(Error);
    board.see(FormError);
    board.pass_ms(60_000);
    let expected = [
        "0 ms listen at 125 kbit/s",
        "49.44 ms listen at 1000 kbit/s",
        "1149.44 ms listen at 125 kbit/s",
        "1198.88 ms 125 kbit/s",
        &format!("1198.88 ms {HOME_AGAIN}"),
        "1198.88 ms receives",
    ];
    assert_eq!(board.timeline(), expected);
}

/// A guest with a heartbeat every 10 ms.
fn guest_with_heartbeat() -> NodeRig {
    let mut board = unproven_at(BitRate::Kbit125, 10);
    board.see(Error);
    board.is_acknowledged = true;
    board.see(Received);
    board.timeline();
    board
}

#[test]
fn a_guest_sends_nothing_of_its_own_accord() {
    let mut board = guest_with_heartbeat();
    for _ in 0..100 {
        board.node.handle_fault(Fault::SettingsLost);
        board.see(Overrun);
        // Requests to others, and one that has no answer.
        board.receive(&testkit::sdo::request(0x41, "40 00 10 00"));
        board.nmt("01 00");
        board.lss("04 00");
        board.pass_ms(1_999);
    }
    assert_eq!(board.timeline(), SILENCE);
    assert_eq!(board.node.nmt_state(), nmt::State::Operational, "it obeys");
    board.nmt("80 00");
    board.see(Error);
    board.see(Error);
    board.is_acknowledged = true;
    board.pass_ms(5_000);
    let sent = board.timeline();
    assert!(sent.iter().any(|act| act.ends_with("740: 7F")), "at home again: {sent:?}");
    assert!(sent.iter().any(|act| act.contains("0C0: 10 63")), "and all is reported: {sent:?}");
}

#[test]
fn a_guest_reports_itself_once_with_the_first_answer() {
    let sdo = || testkit::sdo::request(0x40, "40 18 10 04");
    let serial = "5C0: 43 18 10 04 EF BE AD DE";
    for (request, first, again) in [
        (frames::request("5E"), &[ANSWER, "740: 00", AWAY][..], &[ANSWER][..]),
        (sdo(), &["740: 00", serial, AWAY], &[serial]),
        (frames::command("82 00"), &["740: 00", AWAY], &["740: 00"]),
    ] {
        let mut board = guest_with_heartbeat();
        board.lss("04 01");
        assert_eq!(board.receive(&request).texts(), first, "{request:?}");
        for _ in 0..10 {
            board.node.handle_fault(Fault::SettingsLost);
            assert_eq!(board.pass_ms(1_900), SILENCE, "neither a heartbeat nor another emergency");
            assert_eq!(board.receive(&request).texts(), again, "{request:?}");
        }
    }
}

#[test]
fn a_guest_leaves_after_2_s_without_a_valid_frame() {
    for proof in [None, Some(Received), Some(Acknowledged)] {
        let mut board = guest();
        if let Some(proof) = proof {
            for _ in 0..100 {
                board.pass_ms(1_999);
                board.see(FormError);
                board.see(proof);
            }
        }
        // Those whom it has heard may leave amid a frame.
        board.see(Error);
        assert_eq!(board.timeline(), SILENCE, "{proof:?}");
        assert_eq!(silence_ms(&mut board), 2_000, "{proof:?}");
        board.timeline();
        board.pass_us(TURN_US);
        let expected = ["49.44 ms 125 kbit/s", "49.44 ms 740: 00"];
        assert_eq!(board.timeline()[..2], expected, "nobody is there: it takes part at home");
    }
}

#[test]
fn a_guest_in_lss_configuration_state_stays_for_64_s() {
    let others = [frames::stranger(), frames::request("5A"), frames::command("01 00")];
    for last in others.map(Some).into_iter().chain([None]) {
        let mut board = guest();
        board.lss("04 01");
        board.pass_ms(60_000);
        last.inspect(|frame| _ = board.receive(frame));
        assert_eq!(silence_ms(&mut board), if last.is_some() { 64_000 } else { 4_000 }, "{last:?}");
        assert_eq!(board.node.lss().state(), lss::State::Waiting);
    }
    for end in ["04 00", "82 00"] {
        let mut board = guest();
        board.lss("04 01");
        board.pass_ms(60_000);
        match end {
            "04 00" => board.lss(end),
            _ => board.nmt(end),
        };
        assert_eq!(silence_ms(&mut board), 2_000, "after {end}");
    }
}

#[test]
fn a_guest_answers_17_after_a_pause_of_60_s_in_a_session() {
    let mut board = guest();
    board.configure("11 07");
    board.pass_ms(60_000);
    assert_eq!(board.lss("17"), ["17 00"]);
    assert_eq!(board.stored().map(|settings| settings.node_id), Some(NodeId::new(7)));
}

#[test]
fn ff10_reports_a_rescue_and_its_end_and_the_history_keeps_the_rate() {
    for is_asked in [true, false] {
        let mut board = if is_asked { asked_guest() } else { guest() };
        assert_eq!(board.node.node_id(), NodeId::new(0x40));
        board.see(Error);
        board.see(Error);
        // Of a rescue that nobody has noticed both are reported at home.
        let reports = if is_asked { &[HOME_AGAIN][..] } else { &["740: 00", AWAY, HOME_AGAIN] };
        assert_eq!(board.pass_ms(2_000).texts(), reports);
        assert_eq!(board.number(0x1001, 0), 0);
        assert_eq!(board.number(0x1003, 1), 0x03E8_FF10);
    }
}

#[test]
fn a_rate_found_again_is_no_new_rescue_and_another_one_is() {
    let mut board = asked_guest();
    for (errors, message, rescues) in [
        (0, &[ANSWER][..], [125, 1000, 1]),
        (1, &[ANSWER, "0C0: 10 FF 11 20 03 7D 00 00"], [125, 800, 2]),
    ] {
        board.see(Error);
        board.see(Error);
        board.pass_us(TURN_US);
        (0..errors).for_each(|_| _ = board.see(Error));
        board.see(Received);
        board.lss("04 01");
        assert_eq!(board.lss("5E").texts(), message);
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
