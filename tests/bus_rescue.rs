//! Rescue from a bit rate that is dead: what makes a node listen, where it looks, and when it gives up.

mod support;

use lss_slave::{Action, BitRate, BusEvent, Device, Frame, Instant, Node, Settings, nmt::State};
use support::{
    board::{ADDRESS, Board, defaults, device},
    flash::BoardFlash,
    frames::{self, SILENCE},
};

/// What fails a bit rate on trial.
const FAILURES: [BusEvent; 2] = [BusEvent::ReceivesErrorsOnly, BusEvent::BusOff];

fn new_board(rescue: bool, settings: Settings) -> Board {
    let device = Device { rescue, ..device(ADDRESS) };
    Board::with_device(device, settings, BoardFlash::blank(0), 0)
}

/// A board at 125 kbit/s that is on trial because nobody has set its node-ID and it has not said anything.
fn unheard() -> Board {
    new_board(true, Settings { bit_rate: BitRate::Kbit125.into(), ..defaults(0xFF) })
}

/// A node that has just gone from 1000 to 125 kbit/s, is in configuration state, and has an empty timeline.
fn switched(rescue: bool) -> Board {
    let mut board = new_board(rescue, defaults(0x40));
    board.lss("04 01");
    board.lss("13 00 04");
    board.lss("15 0A 00");
    board.pass_ms(20);
    assert_eq!(board.bit_rate(), BitRate::Kbit125);
    board.timeline();
    board
}

#[test]
fn after_power_on_errors_without_one_good_frame_make_a_node_listen_from_the_fastest_rate_on() {
    for failure in FAILURES {
        let mut board = unheard();
        assert_eq!(board.see(failure), SILENCE);
        assert_eq!(board.timeline(), ["0 ms listen at 1000 kbit/s"], "{failure:?}");
    }
}

#[test]
fn after_a_switch_the_previous_rate_is_listened_to_first_and_on_silence_the_fastest() {
    for failure in FAILURES {
        let mut board = new_board(true, defaults(0x40));
        for index in ["03", "06"] {
            board.lss("04 01");
            board.lss(&format!("13 00 {index}"));
            board.lss("15 00 00");
        }
        board.timeline();
        board.see(failure);
        board.pass_ms(2_000);
        let expected = ["0 ms listen at 250 kbit/s", "1500 ms listen at 1000 kbit/s"];
        assert_eq!(board.timeline(), expected, "{failure:?}");
    }
}

#[test]
fn after_bus_off_a_rate_that_was_proven_is_on_trial_again() {
    let mut board = switched(true);
    board.receive(&frames::stranger());
    board.see(BusEvent::BusOff);
    assert!(!board.node.is_listening(), "once is not enough");
    board.see(BusEvent::BusOff);
    assert!(board.node.is_listening());
    let mut board = switched(true);
    board.receive(&frames::stranger());
    board.see(BusEvent::BusOff);
    board.see(BusEvent::Received);
    board.see(BusEvent::BusOff);
    assert!(!board.node.is_listening(), "a frame was received in between");
}

#[test]
fn one_good_frame_or_one_acknowledge_proves_the_rate_and_no_error_questions_it() {
    for proof in [BusEvent::Received, BusEvent::Acknowledged] {
        for mut board in [unheard(), switched(true)] {
            board.see(proof);
            for _ in 0..1000 {
                board.see(BusEvent::Error);
                board.see(BusEvent::ReceivesErrorsOnly);
                board.pass_ms(250);
            }
            assert_eq!(board.bit_rate(), BitRate::Kbit125, "{proof:?}");
            assert!(!board.node.is_listening(), "{proof:?}");
        }
    }
    let mut board = unheard();
    board.receive(&frames::stranger());
    board.see(BusEvent::ReceivesErrorsOnly);
    assert!(!board.node.is_listening(), "whatever the frame");
}

#[test]
fn eight_times_nothing_but_an_error_is_a_failure_and_seven_times_is_none() {
    for mut board in [unheard(), switched(true)] {
        for _ in 0..7 {
            board.see(BusEvent::Error);
            board.pass_ms(250);
        }
        assert!(!board.node.is_listening());
        board.see(BusEvent::Error);
        assert!(board.node.is_listening());
    }
}

#[test]
fn errors_are_counted_anew_after_each_trial() {
    let mut board = switched(true);
    for _ in 0..7 {
        board.see(BusEvent::Error);
    }
    board.see(BusEvent::Received);
    board.see(BusEvent::BusOff);
    board.see(BusEvent::Error);
    assert!(!board.node.is_listening());
}

#[test]
fn within_the_silent_periods_of_a_switch_errors_do_not_count() {
    for failure in FAILURES {
        let mut board = new_board(true, defaults(0x40));
        board.lss("04 01");
        board.lss("13 00 04");
        board.timeline();
        board.lss("15 64 00");
        for _ in 0..20 {
            board.see(failure);
            board.pass_ms(10);
        }
        let expected = ["0 ms stop", "100 ms 125 kbit/s", "200 ms resume"];
        assert_eq!(board.timeline(), expected, "{failure:?}");
        board.see(failure);
        assert!(board.node.is_listening(), "after them they do");
    }
}

#[test]
fn an_error_while_listening_leads_to_the_next_slower_rate() {
    let mut board = unheard();
    board.see(BusEvent::BusOff);
    for kbit_per_s in [800, 500, 250, 125, 50, 20, 10, 1000] {
        board.see(BusEvent::Error);
        assert_eq!(board.bit_rate().kbit_per_s(), kbit_per_s);
    }
}

#[test]
fn after_30_s_of_silence_a_node_goes_back_to_its_rate_on_trial() {
    for failure in FAILURES {
        let mut board = switched(true);
        board.see(failure);
        assert_eq!(board.pass_us(29_999_999), SILENCE);
        assert!(board.node.is_listening());
        board.pass_us(1);
        assert_eq!(board.bit_rate(), BitRate::Kbit125);
        assert!(!board.node.is_listening());
        assert_eq!(board.lss("5E"), ["5E 40"], "it answers there");

        let mut board = switched(true);
        board.see(failure);
        board.pass_ms(30_000);
        board.see(failure);
        assert!(board.node.is_listening(), "it was on trial");
    }
}

#[test]
fn errors_heard_put_the_return_to_the_old_rate_off() {
    let mut board = switched(true);
    board.see(BusEvent::BusOff);
    for _ in 0..10 {
        board.pass_ms(29_000);
        board.see(BusEvent::Error);
        assert!(board.node.is_listening());
    }
    board.pass_ms(30_000);
    assert!(!board.node.is_listening());
}

#[test]
fn a_device_that_turns_rescue_off_stays_at_its_rate() {
    let mut board = switched(false);
    for _ in 0..100 {
        board.see(BusEvent::Error);
        board.see(BusEvent::ReceivesErrorsOnly);
        board.see(BusEvent::BusOff);
        board.pass_ms(1000);
    }
    assert_eq!(board.timeline(), SILENCE);
    assert_eq!(board.bit_rate(), BitRate::Kbit125);
}

#[test]
fn a_rescued_node_is_as_it_was_and_serves_lss_and_nmt_at_the_rate_of_the_bus() {
    let mut board = new_board(true, Settings { heartbeat_ms: 1000, ..defaults(0x40) });
    board.download(0x1029, 1, &[1]).unwrap(); // Bus-off leaves the NMT state alone.
    board.nmt("01 00");
    board.lss("04 01");
    board.see(BusEvent::BusOff);
    board.see(BusEvent::BusOff);
    board.see(BusEvent::Error);
    board.timeline();
    assert_eq!(board.receive(&frames::stranger()), ["740: 05"], "a heartbeat at once, no boot-up");
    assert_eq!(board.timeline(), ["0 ms 800 kbit/s", "0 ms resume", "0 ms 740: 05"]);
    assert_eq!(board.node.nmt_state(), State::Operational);
    assert_eq!(board.lss("5E"), ["5E 40"], "still in configuration state");
    board.nmt("80 00");
    assert_eq!(board.pass_ms(1000), ["740: 7F"]);
    assert_eq!(board.nmt("82 00"), ["740: 00"]);
    assert_eq!(board.bit_rate(), BitRate::Kbit800);
}

#[test]
fn what_was_configured_survives_a_rescue_and_a_rescue_stores_nothing() {
    let mut board = switched(true);
    board.see(BusEvent::BusOff);
    board.receive(&frames::stranger());
    assert_eq!(board.bit_rate(), BitRate::Kbit1000, "the previous one");
    assert_eq!(board.stored(), None);
    assert_eq!(board.lss("17"), ["17 00"]);
    let pending = Some(BitRate::Kbit125.into());
    assert_eq!(board.stored().map(|settings| settings.bit_rate), pending);
}

/// All that is due at once.
fn actions(node: &mut Node) -> Vec<Action> {
    std::iter::from_fn(|| node.handle_deadline(Instant::from_micros(0))).collect()
}

#[test]
fn a_boot_up_that_nobody_acknowledged_is_sent_again_after_a_rescue() {
    let device = Device { rescue: true, ..device(ADDRESS) };
    let mut node = Node::new(device, defaults(0x40));
    let boot_up = Action::Transmit(Frame::new(0x740, &[0]).expect("a frame"));
    assert_eq!(actions(&mut node), [boot_up]);
    node.handle_bus(BusEvent::BusOff);
    let listen = actions(&mut node);
    assert!(matches!(listen[..], [Action::Listen(_)]));
    node.handle_bus(BusEvent::Received);
    let actions = actions(&mut node);
    assert!(actions.contains(&boot_up), "{actions:?}");
}
