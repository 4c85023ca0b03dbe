//! Bit-rate supervision at home and in a search: a proven rate is never left, and an unproven one is searched from.

use canopen_node::{
    BitRate,
    BusEvent::{self, Acknowledged, BusOff, Error, FormError, HeldDominant, NonePending, Received},
    Frame, Instant, NodeId, lss,
    nmt::State,
};
use testkit::{
    frames::{self, Frames, SILENCE, request},
    node_rig::{ADDRESS, NodeRig, defaults, device},
    supervised::{
        TURN_US, powered_on, proven, searching, switched, unproven, unproven_at, with_defaults,
    },
};

const EVENTS: [BusEvent; 6] = [Error, FormError, BusOff, HeldDominant, Received, Acknowledged];

#[test]
fn a_proven_rate_is_never_left() {
    let proofs: [fn(&mut NodeRig) -> Frames; 5] = [
        |board| board.see(Received),
        |board| board.see(Acknowledged),
        |board| board.receive(&frames::stranger()),
        |board| board.lss("04 00"),
        |board| board.nmt("80 00"),
    ];
    for (number, proof) in proofs.into_iter().enumerate() {
        let mut board = unproven();
        proof(&mut board);
        board.is_acknowledged = false;
        board.configure("11 05, 13 00 02");
        board.timeline();
        for event in EVENTS.into_iter().cycle().take(6_000) {
            board.see(event);
            board.pass_ms(97);
        }
        assert_eq!(board.timeline(), SILENCE, "proof {number}");
        assert_eq!(board.lss("17"), ["17 00"], "the session goes on");
        board.lss("15 00 00");
        assert_eq!(board.bit_rate(), BitRate::Kbit500, "and what 13 has set is activated");
    }
}

#[test]
fn nothing_is_due_after_the_acknowledge_of_an_answer_at_a_proven_rate() {
    let mut board = proven();
    board.lss("04 01");
    let now = Instant::from_micros(board.now() as u32);
    assert!(board.node.handle_frame(&request("5E"), now).is_some());
    assert!(!board.node.is_due(now));
    board.node.handle_bus_event(Acknowledged, now);
    assert!(!board.node.is_due(now));
    assert_eq!(board.us_to_deadline(), None);
}

#[test]
fn nothing_is_due_after_a_request_without_an_answer_at_a_proven_rate() {
    let mut board = proven();
    let now = Instant::from_micros(board.now() as u32);
    for text in ["40 01", "47 01", "5A", "51 00 00 00 00 1F"] {
        assert_eq!(board.node.handle_frame(&request(text), now), None);
        assert!(!board.node.is_due(now), "{text}");
    }
}

#[test]
fn a_node_without_supervision_never_looks_elsewhere_nor_pauses() {
    let mut board = NodeRig::with_heartbeat(0x40, 100);
    board.is_acknowledged = false;
    board.power_cycle();
    for _ in 0..1_000 {
        for event in [NonePending, BusOff, Error, FormError, Error] {
            board.see(event);
        }
        assert_eq!(board.pass_ms(100), ["740: 7F"]);
    }
    assert_eq!(board.bit_rate(), BitRate::Kbit1000);
}

#[test]
fn an_unproven_rate_is_searched_from_at_the_first_error() {
    for (event, expected) in [
        (Error, &["0 ms listen at 1000 kbit/s"][..]),
        (FormError, &["0 ms listen at 1000 kbit/s"]),
        (HeldDominant, &[]),
    ] {
        let mut board = unproven();
        board.see(event);
        assert_eq!(board.timeline(), expected, "{event:?}");
    }
    let mut board = unproven_at(BitRate::Kbit1000, 0);
    board.see(Error);
    assert_eq!(board.timeline(), ["0 ms listen at 800 kbit/s"], "home is heard already");
}

#[test]
fn for_30_s_after_both_switch_delays_only_the_new_rate_counts() {
    for d_ms in [0_u16, 1_000, 65_535] {
        let mut board = powered_on(BitRate::Kbit250, 0);
        board.configure("13 00 06");
        let [low, high] = d_ms.to_le_bytes();
        board.lss(&format!("15 {low:02X} {high:02X}"));
        for _ in 0..2 {
            board.see(Error);
            board.pass_ms(d_ms.into());
        }
        board.timeline();
        for event in [Error, FormError, HeldDominant].into_iter().cycle().take(30_000) {
            board.see(event);
            board.pass_us(999);
        }
        assert_eq!(board.timeline(), SILENCE, "{d_ms} ms");
        board.pass_ms(30);
        board.see(Error);
        assert_eq!(board.timeline(), ["30 ms listen at 250 kbit/s"], "first the rate before");
        board.see(HeldDominant);
        board.timeline();
        board.see(Error);
        assert_eq!(board.timeline(), ["0 ms listen at 1000 kbit/s"], "once");
    }
}

#[test]
fn a_stay_that_hears_nothing_ends_the_search_after_a_turn_of_home() {
    let mut board = searching();
    board.pass_ms(60_000);
    let expected = ["1100 ms listen at 125 kbit/s", "1149.44 ms 125 kbit/s"];
    assert_eq!(board.timeline()[..2], expected);
    board.timeline();
    board.see(Error);
    assert_eq!(board.timeline(), ["0 ms listen at 1000 kbit/s"], "until the next error");
}

#[test]
fn a_heartbeat_follows_each_pause() {
    let mut board = powered_on(BitRate::Kbit250, 60_000);
    board.is_acknowledged = false;
    board.configure("13 00 06, 15 00 00");
    board.timeline();
    board.pass_ms(3_000);
    let timeline = board.timeline();
    let count = |end| timeline.iter().filter(|act| act.ends_with(end)).count();
    assert_eq!((count("drop all"), count("740: 7F")), (4, 4), "{timeline:?}");
}

#[test]
fn a_turn_of_home_lasts_30_ms_and_18_frames_at_every_rate() {
    for home in BitRate::ALL {
        let mut board = unproven_at(home, 0);
        board.see(Error);
        board.pass_ms(1_100);
        assert_eq!(board.bit_rate(), home);
        let us = 30_000 + 18 * 135_000 / u64::from(home.kbit_per_s());
        board.pass_us(us - 1);
        assert!(board.node.is_listening(), "{home:?}");
        board.pass_us(1);
        assert!(!board.node.is_listening(), "{home:?}");
    }
}

#[test]
fn a_stay_ends_40_ms_after_the_first_error() {
    for (heard_at_ms, end_ms) in [(0, 40), (500, 540), (1_080, 1_100)] {
        for error in [Error, FormError] {
            let mut board = searching();
            board.pass_ms(heard_at_ms);
            board.see(error);
            board.timeline();
            let left_ms = end_ms - heard_at_ms;
            board.pass_ms(left_ms / 2);
            board.see(FormError);
            board.pass_ms(left_ms - left_ms / 2);
            assert_eq!(board.timeline(), [format!("{left_ms} ms listen at 125 kbit/s")]);
        }
    }
}

#[test]
fn an_error_leads_to_the_next_slower_rate_home_among_them() {
    let mut board = searching();
    for kbit_per_s in [800, 500, 250, 125, 50, 20, 10, 1000, 800] {
        board.see(Error);
        assert_eq!(board.timeline(), [format!("0 ms listen at {kbit_per_s} kbit/s")]);
    }
}

#[test]
fn the_next_stay_goes_on_where_the_last_one_ended() {
    for (errors, at_home, next) in [
        (&[Error, Error][..], &[][..], 500),
        (&[FormError], &[], 800),
        (&[FormError, Error], &[], 800),
        (&[], &[Error], 800),
        (&[FormError], &[FormError], 800),
        (&[Error], &[Error, Error], 800),
    ] {
        let mut board = searching();
        errors.iter().for_each(|&error| _ = board.see(error));
        board.pass_ms(if errors.is_empty() { 1_100 } else { 40 });
        assert_eq!(board.bit_rate(), BitRate::Kbit125);
        at_home.iter().for_each(|&error| _ = board.see(error));
        board.timeline();
        board.pass_us(TURN_US);
        let expected = [format!("49.44 ms listen at {next} kbit/s")];
        assert_eq!(board.timeline(), expected, "{errors:?}, at home {at_home:?}");
    }
}

#[test]
fn a_frame_without_acknowledge_at_home_does_not_prolong_the_search() {
    let mut board = searching();
    board.pass_ms(1_100);
    board.see(FormError);
    board.timeline();
    board.pass_us(TURN_US);
    assert_eq!(board.timeline()[0], "49.44 ms 125 kbit/s");
}

#[test]
fn while_errors_go_on_home_is_never_away_for_100_ms() {
    for (error, us) in [(Error, 300), (Error, 20_000), (FormError, 300), (FormError, 20_000)] {
        let mut board = searching();
        let mut away_us = 0;
        for _ in 0..20_000_000 / us {
            board.see(error);
            board.pass_us(us);
            let is_away = board.bit_rate() != BitRate::Kbit125;
            away_us = if is_away { away_us + us } else { 0 };
            assert!(away_us < 100_000, "{error:?} every {us} us");
        }
        let timeline = board.timeline();
        assert!(timeline.len() > 200, "it continues to search");
        let sent = timeline.iter().filter(|act| act.contains(" 740: ")).count();
        assert!(sent <= 20_000 / 700, "{sent} frames: silent but once a round");
    }
}

#[test]
fn after_eight_stays_without_a_valid_frame_the_node_takes_part_at_home_until_the_next_error() {
    let mut board = searching();
    for _ in 0..8 {
        assert!(board.node.is_listening());
        board.see(FormError);
        board.pass_ms(40);
        board.pass_us(TURN_US);
    }
    assert_eq!((board.bit_rate(), board.node.is_listening()), (BitRate::Kbit125, false));
    board.see(Error);
    assert_eq!((board.bit_rate(), board.node.is_listening()), (BitRate::Kbit1000, true));
}

#[test]
fn a_valid_frame_at_home_ends_the_search_and_proves_home() {
    let boot_up = Frame::new(0x701, &[0]).expect("one byte");
    for stays_ms in [1_100, 0] {
        let mut board = searching();
        if stays_ms == 0 {
            // In the round, as at any other rate.
            for _ in 0..4 {
                board.see(Error);
            }
        }
        board.pass_ms(stays_ms);
        assert_eq!(board.bit_rate(), BitRate::Kbit125);
        board.timeline();
        board.receive(&boot_up);
        assert_eq!(board.timeline(), ["0 ms 125 kbit/s", "0 ms 740: 00"]);
        for _ in 0..100 {
            board.see(Error);
            board.pass_ms(100);
        }
        assert_eq!(board.timeline(), SILENCE);
    }
}

#[test]
fn a_boot_up_elsewhere_is_not_heard_but_a_heartbeat_makes_a_guest() {
    for (state, is_guest) in [(0x00, false), (0x05, true), (0x7F, true)] {
        let mut board = searching();
        let frame = Frame::new(0x701, &[state]).expect("one byte");
        board.is_acknowledged = is_guest;
        board.receive(&frame);
        assert_eq!(!board.node.is_listening(), is_guest, "{state:02X}");
        board.pass_us(1_100_000 + TURN_US);
        assert!(!board.node.is_listening());
        assert_eq!(board.bit_rate() == BitRate::Kbit1000, is_guest, "{state:02X}");
    }
}

#[test]
fn an_acknowledge_that_comes_after_the_first_error_decides_nothing() {
    let mut board = searching();
    board.see(Acknowledged);
    assert_eq!(board.timeline(), SILENCE);
}

#[test]
fn a_bus_that_is_held_dominant_ends_the_search() {
    for us in [1, 40_000, 40_000 + TURN_US] {
        let mut board = searching();
        board.see(Error);
        board.pass_us(us);
        board.timeline();
        board.see(HeldDominant);
        assert_eq!(board.timeline()[0], "0 ms 125 kbit/s", "after {us} us");
        board.pass_ms(10_000);
        assert!(!board.timeline().iter().any(|act| act.contains("listen")), "after {us} us");
    }
}

#[test]
fn a_search_ends_the_lss_session() {
    for (node_id, then) in [(0x40, Some(5)), (0xFF, None)] {
        let mut board = with_defaults(defaults(node_id).with_bit_rate(BitRate::Kbit250.into()));
        board.configure("11 05, 13 00 06, 15 00 00");
        board.pass_ms(30_000);
        board.see(Error);
        assert_eq!(board.node.lss().state(), lss::State::Waiting);
        // A node without an active node-ID has no pending one either.
        assert_eq!(board.node.lss().pending_node_id(), then.and_then(NodeId::new));
    }
}

#[test]
fn an_unacknowledged_frame_pauses_after_100_ms_at_an_unproven_rate() {
    let serials = [(0, "400"), (0xDEAD_BEEF, "639"), (u32::MAX, "655")];
    for (serial_number, pause) in serials {
        let address = lss::Address { serial_number, ..ADDRESS };
        let settings = defaults(0x40).with_bit_rate(BitRate::Kbit125.into());
        let device = device(address).with_rescue(true).with_defaults(settings);
        let mut board = NodeRig::of(device);
        board.is_acknowledged = false;
        board.power_cycle();
        board.timeline();
        board.pass_ms(900);
        let again = 100 + pause.parse::<u32>().expect("a number");
        let expected = [
            "100 ms drop all",
            &format!("{again} ms 740: 00"),
            &format!("{} ms drop all", again + 100),
        ];
        let timeline = board.timeline();
        assert_eq!(timeline[..expected.len().min(timeline.len())], expected);
        board.is_acknowledged = true;
        board.pass_ms(1_000);
        board.timeline();
        board.is_acknowledged = false;
        board.configure("5E");
        board.pass_ms(1_000);
        assert_eq!(board.timeline().len(), 1, "a proven one does not pause");
    }
}

#[test]
fn a_request_in_a_pause_ends_it_and_is_answered() {
    let mut board = unproven();
    board.pass_ms(110);
    board.is_acknowledged = true;
    let request = testkit::sdo::request(0x40, "40 18 10 04");
    let expected = ["740: 00", "5C0: 43 18 10 04 EF BE AD DE"];
    assert_eq!(board.receive(&request), expected);
    let mut board = unproven();
    board.pass_ms(110);
    board.is_acknowledged = true;
    assert_eq!(board.nmt("01 00"), ["740: 00"]);
    assert_eq!(board.node.nmt_state(), State::Operational, "a boot-up sent again changes no state");
}

#[test]
fn bus_off_at_an_unproven_rate_listens_for_a_pause_in_the_same_session() {
    let mut board = switched();
    board.is_acknowledged = false;
    board.see(BusOff);
    board.see(BusOff);
    assert_eq!(board.timeline(), ["0 ms listen at 50 kbit/s"], "it destroys no frame of others");
    board.pass_ms(700);
    assert_eq!(board.timeline(), ["639 ms 50 kbit/s"]);
    board.see(BusOff);
    board.is_acknowledged = true;
    assert_eq!(board.lss("5E"), SILENCE, "it is repeated until someone acknowledges it");
    assert_eq!(board.lss("5E"), ["5E 40"]);
    board.timeline();
    board.see(BusOff);
    assert_eq!(board.timeline(), SILENCE, "a proven one recovers like any other node");
}
