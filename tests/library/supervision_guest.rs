//! Bit-rate supervision of a guest: taking part at a rate found by listening, and returning home.

use lss_slave::{
    BitRate, BitRateSetting,
    BusEvent::{Acknowledged, BusOff, Error, ErrorPassive, FormError, Received},
    NodeId, lss, nmt,
};
use testkit::{
    flash::BoardFlash,
    frames::{self, SILENCE},
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::Client,
    supervised::{doubt, guest, looking, powered_on, proven, unproven},
};

/// Emergency FF10h with 1000 kbit/s in use and 125 kbit/s at home; and its end.
const AWAY: &str = "0C0: 10 FF 11 E8 03 7D 00 00";
const HOME_AGAIN: &str = "0C0: 00 00 00 E8 03 7D 00 00";

/// The active and the pending bit rate of LSS, in kbit/s.
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

/// Makes a board at home a guest at 1000 kbit/s.
fn rescue(board: &mut NodeRig) {
    doubt(board);
    board.see(Received);
    assert_eq!(board.bit_rate(), BitRate::Kbit1000);
}

/// Sends a guest home and keeps the bus quiet until it stays there.
fn send_home(board: &mut NodeRig) {
    board.see(Error);
    board.see(Error);
    board.pass_ms(2_000);
    assert_eq!(board.bit_rate(), BitRate::Kbit125);
}

#[test]
fn the_first_valid_frame_elsewhere_decides_and_is_not_obeyed() {
    let mut board = powered_on(BitRate::Kbit125, 400);
    board.nmt("01 00");
    board.lss("04 01");
    board.is_acknowledged = false;
    doubt(&mut board);
    board.is_acknowledged = true;
    board.timeline();
    board.receive(&frames::request("04 00"));
    let expected = [
        "0 ms 1000 kbit/s".to_owned(),
        "0 ms resume".to_owned(),
        format!("0 ms {AWAY}"),
        "0 ms 740: 05".to_owned(),
    ];
    assert_eq!(board.timeline(), expected, "a heartbeat at once, no boot-up");
    assert_eq!(board.node.nmt_state(), nmt::State::Operational);
    board.lss("04 01");
    assert_eq!(board.lss("5E"), ["5E 40"], "the second is");
}

#[test]
fn a_node_that_looks_elsewhere_is_no_longer_selected() {
    let mut board = proven();
    board.lss("04 01");
    doubt(&mut board);
    // Meanwhile, the master leaves the configuration state and selects another device.
    assert_eq!(board.node.lss().state(), lss::State::Waiting);
    board.see(Received);
    assert_eq!(board.lss("11 05"), SILENCE, "it is for the other one");
    assert_eq!(board.node.lss().pending_node_id(), NodeId::new(0x40));
}

#[test]
fn a_guest_that_leaves_is_no_longer_selected() {
    let mut board = guest();
    board.lss("04 01");
    assert_eq!(board.lss("5E"), ["5E 40"]);
    send_home(&mut board);
    assert_eq!(board.lss("5E"), SILENCE);
}

#[test]
fn a_frame_that_no_canopen_node_wants_makes_a_guest_too() {
    let mut board = looking();
    board.see(Error);
    board.receive(&frames::stranger());
    assert_eq!(board.bit_rate(), BitRate::Kbit800);
    assert!(!board.node.is_listening());
}

#[test]
fn a_guest_without_an_acknowledged_boot_up_boots_up() {
    let mut board = unproven();
    board.is_acknowledged = true;
    board.see(Error);
    assert_eq!(board.see(Received), ["740: 00", AWAY]);
}

#[test]
fn the_rate_found_is_active_and_pending_until_the_node_is_home_again() {
    let mut board = guest();
    assert_eq!(lss_rates(&board), [1000, 1000]);
    assert_eq!(board.stored(), None, "nothing is stored without a request");
    send_home(&mut board);
    assert_eq!(lss_rates(&board), [125, 125]);
}

#[test]
fn store_configuration_of_a_guest_stores_the_rate_found() {
    let mut board = guest();
    for request in ["04 01", "11 07", "17"] {
        board.lss(request);
    }
    let settings = board.stored().expect("settings");
    assert_eq!(settings.bit_rate, BitRate::Kbit1000.into());
    board.power_cycle();
    assert_eq!(board.bit_rate(), BitRate::Kbit1000);
}

#[test]
fn a_bit_rate_that_was_configured_stays_pending_when_another_is_found() {
    let mut board = proven();
    board.lss("04 01");
    board.lss("13 00 02");
    rescue(&mut board);
    assert_eq!(lss_rates(&board), [1000, 500]);
    board.lss("04 01");
    assert_eq!(board.lss("17"), ["17 00"]);
    assert_eq!(board.stored().map(|settings| settings.bit_rate), Some(BitRate::Kbit500.into()));
    send_home(&mut board);
    assert_eq!(lss_rates(&board), [125, 500]);
    board.lss("04 01");
    board.lss("15 00 00");
    assert_eq!(board.bit_rate(), BitRate::Kbit500);
}

#[test]
fn activation_without_configuration_makes_the_rate_found_home() {
    let mut board = guest();
    board.lss("04 01");
    board.timeline();
    board.lss("15 0A 00");
    board.pass_ms(20);
    let end = format!("20 ms {HOME_AGAIN}");
    assert_eq!(board.timeline(), ["0 ms stop", "20 ms resume", &end]);
    assert_eq!(objects(&mut board), [1000, 1000, 1]);
    board.timeline();
    board.is_acknowledged = false;
    for _ in 0..299 {
        board.see(Error);
        board.pass_ms(100);
    }
    assert_eq!(board.timeline(), SILENCE, "a commanded rate is trusted");
}

#[test]
fn a_rate_found_that_is_activated_is_proven() {
    let mut board = unproven();
    board.see(Error);
    board.see(Received);
    board.lss("04 01");
    board.lss("15 00 00");
    board.pass_ms(30_000);
    board.see(Error);
    board.see(Error);
    assert!(!board.node.is_listening());
}

#[test]
fn a_guest_that_is_switched_home_is_home() {
    let mut board = guest();
    for request in ["04 01", "13 00 04", "15 00 00"] {
        board.lss(request);
    }
    assert_eq!(objects(&mut board), [125, 125, 1]);
    assert_eq!(board.number(0x1001, 0), 0);
}

#[test]
fn a_guest_goes_home_at_the_second_error_without_a_valid_frame() {
    for proof in [Received, Acknowledged] {
        let mut board = guest();
        for _ in 0..20 {
            board.see(Error);
            board.see(proof);
            board.see(FormError);
            board.pass_us(2_500_000);
            board.see(Error);
            board.see(proof);
        }
        assert_eq!(board.timeline(), SILENCE, "{proof:?}");
        board.see(FormError);
        board.pass_us(2_499_999);
        board.see(Error);
        assert_eq!(board.timeline(), ["2499.999 ms listen at 125 kbit/s"]);
    }
}

#[test]
fn a_guest_goes_home_when_a_frame_finds_no_acknowledge_for_a_second() {
    let mut board = powered_on(BitRate::Kbit125, 400);
    board.is_acknowledged = false;
    doubt(&mut board);
    board.timeline();
    board.see(Received);
    board.pass_us(999_999);
    for proof in [Received, Acknowledged] {
        board.see(proof);
        board.timeline();
        board.pass_us(1_000_000);
        assert!(!board.node.is_listening(), "the second begins with the next frame: {proof:?}");
    }
    board.pass_ms(1_000);
    let listens = |line: &String| line.contains("listen at 125");
    assert!(board.timeline().iter().any(listens));
}

#[test]
fn an_answer_of_a_guest_that_finds_no_acknowledge_sends_it_home() {
    for request in [frames::request("5E"), testkit::sdo::request(0x40, "40 00 10 00")] {
        let mut board = guest();
        board.lss("04 01");
        board.pass_ms(60_000);
        board.is_acknowledged = false;
        board.timeline();
        board.receive(&request);
        board.pass_ms(1_000);
        let expected = ["100 ms stop", "100 ms resume", "1000 ms listen at 125 kbit/s"];
        assert_eq!(board.timeline()[1..], expected, "{request:?}");
    }
}

#[test]
fn bus_off_and_error_passive_alone_do_not_send_a_guest_home() {
    let mut board = guest();
    for _ in 0..100 {
        board.see(BusOff);
        board.see(ErrorPassive);
        board.pass_ms(100);
        assert_eq!(board.bit_rate(), BitRate::Kbit1000);
        assert!(!board.node.is_listening());
    }
}

#[test]
fn a_guest_that_goes_home_looks_once_more_where_it_was() {
    let mut board = guest();
    board.see(Error);
    board.see(Error);
    board.pass_ms(60_000);
    let expected = [
        "0 ms listen at 125 kbit/s",
        "22.16 ms 125 kbit/s",
        "22.16 ms resume",
        "172.16 ms listen at 1000 kbit/s",
        "1272.16 ms listen at 125 kbit/s",
        "1294.32 ms 125 kbit/s",
        "1294.32 ms resume",
        &format!("1444.32 ms {HOME_AGAIN}"),
    ];
    assert_eq!(board.timeline(), expected);
}

#[test]
fn an_error_at_home_does_not_change_where_a_guest_looks_once_more() {
    let mut board = guest();
    board.see(Error);
    board.see(Error);
    assert_eq!(board.bit_rate(), BitRate::Kbit125);
    board.see(Error);
    board.timeline();
    board.pass_ms(25);
    assert_eq!(board.timeline(), ["22.16 ms listen at 1000 kbit/s"]);
}

#[test]
fn a_valid_frame_in_a_turn_of_home_ends_a_guests_stay() {
    let mut board = guest();
    board.see(Error);
    board.see(Error);
    assert_eq!(board.see(Received), [HOME_AGAIN]);
    assert_eq!(objects(&mut board), [125, 125, 1]);
    assert_eq!(lss_rates(&board), [125, 125]);
}

#[test]
fn home_rate_rate_in_use_and_rescues_can_be_read() {
    let mut board = proven();
    assert_eq!(objects(&mut board), [125, 125, 0]);
    rescue(&mut board);
    assert_eq!(objects(&mut board), [125, 1000, 1]);
    send_home(&mut board);
    assert_eq!(objects(&mut board), [125, 125, 1]);
    rescue(&mut board);
    assert_eq!(objects(&mut board), [125, 1000, 2]);
}

#[test]
fn ff10_reports_a_rescue_and_its_end_and_the_history_keeps_the_rate() {
    let mut board = looking();
    assert_eq!(board.see(Received), [AWAY]);
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
    board.see(Error);
    board.see(Error);
    board.pass_ms(180);
    assert_eq!(board.see(Received), SILENCE, "the same");
    assert_eq!(objects(&mut board), [125, 1000, 1]);
    board.see(Error);
    board.see(Error);
    board.pass_ms(180);
    board.see(Error);
    assert_eq!(board.see(Received), ["0C0: 10 FF 11 20 03 7D 00 00"], "800 kbit/s");
    assert_eq!(objects(&mut board), [125, 800, 2]);
    assert_eq!(lss_rates(&board), [800, 800]);
}

#[test]
fn activation_that_is_the_first_frame_in_a_turn_of_home_stays_home() {
    let mut board = guest();
    board.lss("04 01");
    board.see(Error);
    board.see(Error);
    board.pass_ms(100);
    assert!(!board.node.is_listening(), "the open turn");
    board.lss("15 00 00");
    board.pass_ms(100);
    assert_eq!(board.bit_rate(), BitRate::Kbit125);
    assert_eq!(objects(&mut board), [125, 125, 1]);
}

/// A board that offers automatic detection, with this bit rate.
fn with_automatic(bit_rate: BitRateSetting) -> NodeRig {
    let device = device(ADDRESS);
    let bit_rates = device.bit_rates.with_automatic();
    let device = device.with_bit_rates(bit_rates).with_rescue(true);
    let settings = defaults(0x40).with_bit_rate(bit_rate);
    NodeRig::with_device(device.with_defaults(settings), BoardFlash::blank(0), 0)
}

#[test]
fn a_guest_commanded_to_detect_its_rate_is_no_longer_a_guest() {
    let mut board = with_automatic(BitRate::Kbit125.into());
    rescue(&mut board);
    for request in ["04 01", "13 00 09", "15 00 00"] {
        board.lss(request);
    }
    assert!(board.node.is_listening());
    assert_eq!(board.see(Received), [HOME_AGAIN]);
    assert_eq!(objects(&mut board), [1000, 1000, 1]);
    assert_eq!(board.number(0x1001, 0), 0);
}

#[test]
fn a_detected_rate_is_not_trusted_as_a_commanded_one_is() {
    let mut board = with_automatic(BitRate::Kbit125.into());
    for request in ["04 01", "13 00 02", "15 00 00", "13 00 09", "15 00 00"] {
        board.lss(request);
    }
    board.see(Received);
    assert_eq!(board.bit_rate(), BitRate::Kbit1000);
    doubt(&mut board);
}

#[test]
fn automatic_detection_stays_active_while_the_node_is_a_guest() {
    let mut board = with_automatic(BitRateSetting::Automatic);
    for _ in 0..4 {
        board.see(Error);
    }
    board.see(Received);
    assert_eq!(board.bit_rate(), BitRate::Kbit125);
    rescue(&mut board);
    assert_eq!(lss_rates(&board), [0, 0]);
    assert_eq!(objects(&mut board), [125, 1000, 1]);
}
