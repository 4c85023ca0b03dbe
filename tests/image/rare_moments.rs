//! The release image at moments that are rare: a deadline, a reset, a wrap of the time or a dominant bus in the middle
//! of something else. `cargo xtask coverage` shows the branches that only they take.

use std::collections::BTreeSet;

use emulator::{
    Time,
    board::{self, Board},
    can::{Adapter, Frame, Id},
    chip::{Access, Pin, Readings, Timing, Width},
    network::{AdapterId, Event, Short, What},
};
use lss_slave::{BitRate, BitRateSetting, Settings};
use testkit::{
    frames::{self},
    image::{image, part},
    image_rig::{ImageRig, SETTINGS_OFFSET, bit_per_s, flash_with, settings},
    sdo,
};

const RATE: BitRate = BitRate::Kbit1000;
/// The other rate of these tests.
const OTHER_RATE: BitRate = BitRate::Kbit250;
const NODE_ID: u8 = 0x40;

fn rig(of_chip: Readings, stored: Settings) -> ImageRig {
    let of_board = board::Settings { chip_readings: of_chip, ..Default::default() };
    let mut board = Board::new(part(), image(), of_board);
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[stored]));
    let mut rig = ImageRig::new(RATE, [board]);
    rig.collect(Time::from_ms(100));
    rig
}

fn node_40(heartbeat_ms: u16) -> ImageRig {
    rig(Readings::default(), settings(NODE_ID, RATE).with_heartbeat_ms(heartbeat_ms))
}

/// Node 40 with a core that is `slowdown` times slower.
fn slow_node_40(slowdown: u8) -> ImageRig {
    rig(Readings { slowdown, ..Readings::default() }, settings(NODE_ID, RATE))
}

/// Passes time that the board does not notice but in its count.
fn skip_minutes(rig: &mut ImageRig, minutes: u32) {
    const TIM2_CNT: u32 = 0x4000_0024;
    let board = rig.network.board(0);
    let counter = Access { address: TIM2_CNT, width: Width::Word, now: board.now(), pc: 0 };
    let count = board.chip().read(counter).expect("a register");
    board.chip().write(counter, count.wrapping_add(minutes * 60_000_000)).expect("a register");
    // An interrupt sets the next deadline.
    rig.queue(&frames::request("04 00"));
}

/// Makes the bus dominant for a while.
fn hold_dominant(rig: &mut ImageRig, span: Time) {
    rig.network.set_short(Some(Short::Dominant));
    rig.network.run_for(span);
    rig.network.set_short(None);
}

#[test]
fn a_boot_up_that_is_repeated_after_half_an_hour_restarts_the_heartbeat() {
    let mut rig = node_40(1000);
    rig.network.adapter_mut(rig.master).close();
    rig.power_cycle(0);
    let since = rig.network.now();
    while !rig.did(0, since).any(|event| matches!(event.what, What::Aborted { .. })) {
        rig.network.run_for(Time::from_ms(1));
    }
    rig.network.adapter_mut(rig.master).open();
    skip_minutes(&mut rig, 40);
    let sent = rig.collect(Time::from_ms(900));
    assert_eq!(sent.texts()[0], "740: 00");
    assert_eq!(rig.collect(Time::from_ms(200)).texts(), ["740: 7F"]);
}

#[test]
fn errors_far_apart_do_not_start_a_search() {
    let mut rig = node_40(0);
    let since = rig.network.now();
    for seconds in [3, 1, 3, 1, 1] {
        hold_dominant(&mut rig, Time::from_us(10));
        rig.network.run_for(Time::from_s(seconds));
    }
    assert_eq!(rig.bit_rates(0, since), []);
    assert!(rig.is_reached());
}

#[test]
fn a_reset_leaves_a_save_unanswered_whose_end_waits_behind_errors() {
    let mut rig = node_40(0);
    rig.network.board(0).chip().flash_mut().set_timing(Timing::Worst);
    rig.queue(&sdo::request(NODE_ID, "2B 17 10 00 E8 03"));
    rig.queue(&sdo::request(NODE_ID, "23 10 10 01 73 61 76 65"));
    // Behind the request to save.
    rig.network.run_for(Time::from_us(420));
    hold_dominant(&mut rig, Time::from_us(300));
    // The save has ended by then, and errors withhold frames for 50 ms.
    rig.network.run_for(Time::from_ms(25));
    rig.queue(&frames::command("82 40"));
    let sent = rig.collect(Time::from_ms(20));
    let is_answer = |frame: &lss_slave::Frame| frame.cob_id() == 0x5C0;
    assert_eq!(sent.0.iter().filter(|frame| is_answer(frame)).count(), 1, "{sent:?}");
    rig.power_cycle(0);
    rig.collect(Time::from_ms(500));
    assert_eq!(rig.collect(Time::from_ms(1_000)).texts(), ["740: 7F"]);
}

#[test]
fn a_store_by_lss_is_answered_after_a_reset() {
    let mut rig = node_40(0);
    rig.network.board(0).chip().flash_mut().set_timing(Timing::Worst);
    for request in ["04 01", "11 41"] {
        rig.lss(request);
    }
    rig.queue(&frames::request("17"));
    rig.queue(&frames::command("82 40"));
    assert_eq!(rig.collect(Time::from_ms(20)).texts(), ["741: 00", "7E4: 17 00 00 00 00 00 00 00"]);
}

#[test]
fn a_listener_leaves_a_rate_after_many_form_errors() {
    let stored = settings(NODE_ID, RATE).with_bit_rate(BitRateSetting::Automatic);
    let mut rig = rig(Readings::default(), stored);
    let other = rig.network.add_adapter(Adapter::new(bit_per_s(RATE)));
    rig.network.adapter_mut(rig.master).close();
    let since = rig.network.now();
    // An adapter that leaves the bus after some attempts, each of which lacks an acknowledge, is never error passive.
    let mut errors = 0;
    for _ in 0..3 {
        rig.network.adapter_mut(other).open();
        rig.network.send(other, Frame::data(Id::Standard(0x181), &[0xAA; 8]));
        let before = rig.network.adapter_mut(other).errors();
        while rig.network.adapter_mut(other).errors() < before + 10 {
            rig.network.run_for(Time::from_us(1));
        }
        // In the intermission.
        rig.network.run_for(Time::from_us(15));
        rig.network.adapter_mut(other).close();
        errors += 10;
        assert_eq!(!rig.bit_rates(0, since).is_empty(), errors > 20);
    }
    rig.network.adapter_mut(rig.master).open();
    assert!(rig.is_reached());
}

#[test]
fn a_listener_finds_the_rate_by_remote_frames_or_29_bit_frames() {
    let stored = settings(NODE_ID, RATE).with_bit_rate(BitRateSetting::Automatic);
    for id in [Id::Standard(0x181), Id::Extended(0x181)] {
        let mut rig = rig(Readings::default(), stored);
        let other = rig.network.add_adapter(Adapter::new(bit_per_s(RATE)));
        let frame = Frame { remote: matches!(id, Id::Standard(_)), ..Frame::data(id, &[]) };
        let since = rig.network.now();
        rig.network.send(other, frame);
        rig.network.run_for(Time::from_ms(50));
        let sent: Vec<_> = rig.requested(0, since).map(|(_, frame)| frame.id).collect();
        assert_eq!(sent, [Id::Standard(0x740)], "{frame}");
    }
}

#[test]
fn lss_answers_outlive_a_change_of_the_node_id() {
    for slowdown in [20, 30] {
        let mut rig = slow_node_40(slowdown);
        rig.lss("04 01");
        for request in ["11 41", "5A", "5B"] {
            rig.queue(&frames::request(request));
        }
        rig.queue(&frames::command("82 00"));
        let sent = rig.collect(Time::from_ms(50)).texts();
        let mut begins: Vec<&str> = sent.iter().map(|text| &text[..7]).collect();
        begins.sort_unstable();
        assert_eq!(begins, ["741: 00", "7E4: 11", "7E4: 5A", "7E4: 5B"], "{slowdown}");
    }
}

#[test]
fn a_dominant_bus_ends_a_search_in_each_of_its_turns() {
    let mut rig = node_40(100);
    let disturber = rig.add_disturber();
    let mut turns = BTreeSet::new();
    for ms in (0..200).step_by(25) {
        let id = Id::Standard(0x555);
        rig.disturb(disturber, id, Time::from_us(500), Time::from_ms(1_250 + ms));
        let chip = rig.network.board(0).chip();
        if chip.can(1).is_silent() {
            turns.insert(chip.can(1).bit_rate() == bit_per_s(RATE));
        }
        drop(chip);
        hold_dominant(&mut rig, Time::from_ms(60));
        rig.network.run_for(Time::from_ms(100));
    }
    assert!(rig.is_reached());
    assert_eq!(turns, BTreeSet::from([false, true]), "it listened elsewhere and at home");
}

/// A board on a quiet bus that looks for another bit rate, and has just begun to take part at home between two looks.
fn board_with_home_open(rate: BitRate) -> ImageRig {
    let mut board = Board::new(part(), image(), board::Settings::default());
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[settings(NODE_ID, rate)]));
    let mut rig = ImageRig::new(rate, [board]);
    rig.collect(Time::from_s(1));
    let error = rig.bit_time() * 10;
    while !is_silent(&rig) {
        hold_dominant(&mut rig, error);
        rig.network.run_for(Time::from_ms(20));
    }
    // An error at the other rate makes it look once more.
    hold_dominant(&mut rig, error);
    run_while(&mut rig, is_silent);
    rig
}

fn is_silent(rig: &ImageRig) -> bool {
    rig.network.board(0).chip().can(1).is_silent()
}

/// Passes time while a condition holds, at most 5 s; returns how long it was.
fn run_while(rig: &mut ImageRig, condition: impl Fn(&ImageRig) -> bool) -> Time {
    let since = rig.network.now();
    while condition(rig) && rig.network.now() < since + Time::from_s(5) {
        rig.network.run_for(Time::from_us(100));
    }
    rig.network.now() - since
}

#[test]
fn a_dominant_bus_ends_a_search_while_home_is_open() {
    let mut rig = board_with_home_open(RATE);
    let since = rig.network.now();
    hold_dominant(&mut rig, Time::from_ms(60));
    rig.network.run_for(Time::from_s(2));
    assert_eq!(rig.bit_rates(0, since), []);
    assert!(rig.is_reached());
}

#[test]
fn home_is_open_for_longer_at_10_kbit_per_s() {
    for (rate, ms) in [(RATE, 150), (BitRate::Kbit10, 300)] {
        let mut rig = board_with_home_open(rate);
        let open = run_while(&mut rig, |rig| !is_silent(rig));
        let expected = Time::from_ms(ms - 2)..Time::from_ms(ms + 2);
        assert!(expected.contains(&open), "{rate:?}: {open}");
    }
}

#[test]
fn a_guest_may_become_error_passive_by_the_error_that_sends_it_home() {
    let slow = Readings { slowdown: 40, ..Readings::default() };
    let mut rig = rig(slow, settings(NODE_ID, OTHER_RATE));
    assert!(rig.is_reached());
    let is_at = |rig: &ImageRig, rate| {
        rig.network.board(0).chip().can(1).bit_rate() == bit_per_s(rate) && !is_silent(rig)
    };
    rig.collect(Time::from_s(1));
    assert!(is_at(&rig, RATE), "it is a guest at the rate of the master");
    let since = rig.network.now();
    let error = rig.bit_time() * 50;
    hold_dominant(&mut rig, error);
    rig.network.run_for(Time::from_ms(30));
    assert_eq!(rig.bit_rates(0, since), [], "a guest bears one error");
    hold_dominant(&mut rig, Time::from_ms(2));
    rig.network.run_for(Time::from_ms(30));
    let rates = rig.bit_rates(0, since);
    assert!(rates.iter().any(|(_, rate)| *rate == bit_per_s(OTHER_RATE)), "{rates:?}");
}

#[test]
fn the_last_repetition_may_be_acknowledged_after_its_time() {
    const REPETITION: Time = Time::from_ms(100);
    let mut rig = node_40(0);
    rig.lss("04 01");
    let mut delays = Vec::new();
    for us in (0..500).step_by(20) {
        let since = rig.transmit_request("5E");
        rig.network.adapter_mut(rig.master).close();
        rig.network.run_for(REPETITION - Time::from_us(us));
        rig.network.adapter_mut(rig.master).open();
        rig.network.run_for(Time::from_ms(1));
        let (begin, _) = rig.requested(0, since).next().expect("an answer");
        let is_frame = |event: &&Event| matches!(event.what, What::Frame { .. });
        delays.extend(rig.did(0, since).find(is_frame).map(|frame| frame.time - begin));
        assert!(rig.is_reached());
    }
    assert!(delays.iter().any(|delay| *delay < REPETITION), "{delays:?}");
    assert!(delays.iter().any(|delay| *delay > REPETITION), "{delays:?}");
}

#[test]
fn a_deadline_of_a_search_may_pass_just_before_a_frame_is_handled() {
    let mut rig = slow_node_40(40);
    rig.set_master_bit_rate(OTHER_RATE);
    // A boot-up does not end a search.
    let boot_up = lss_slave::Frame::new(0x702, &[0]).expect("a frame");
    let until = rig.network.now() + Time::from_s(5);
    while rig.network.now() < until {
        if rig.network.adapter_mut(rig.master).unsent() == 0 {
            rig.queue(&boot_up);
        }
        rig.network.run_for(Time::from_ms(1));
    }
    rig.network.adapter_mut(rig.master).close();
    rig.network.adapter_mut(rig.master).open();
    assert!(rig.is_reached());
}

#[test]
fn an_error_during_the_long_recovery_at_a_slow_rate_does_not_shorten_it() {
    const SLOW: BitRate = BitRate::Kbit10;
    let stored = settings(NODE_ID, SLOW).with_heartbeat_ms(500);
    let mut board = Board::new(part(), image(), board::Settings::default());
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[stored]));
    let mut rig = ImageRig::new(SLOW, [board]);
    rig.collect(Time::from_ms(100));
    rig.network.set_short(Some(Short::Recessive));
    while !rig.did(0, Time::ZERO).any(|event| event.what == What::BusOff) {
        rig.network.run_for(Time::from_ms(1));
    }
    let bus_off = rig.network.now();
    rig.network.set_short(None);
    rig.network.run_for(Time::from_ms(20));
    hold_dominant(&mut rig, Time::from_us(900));
    rig.collect(Time::from_s(1));
    let (next, _) = rig.requested(0, bus_off).next().expect("a frame");
    assert!(next > bus_off + Time::from_ms(138), "after {}", next - bus_off);
}

/// Sends frames for `span` that are none at the rate of the board.
fn disturb(rig: &mut ImageRig, disturber: AdapterId, span: Time) {
    rig.network.adapter_mut(disturber).open();
    let until = rig.network.now() + span;
    while rig.network.now() < until {
        rig.network.send(disturber, Frame::data(Id::Standard(0x555), &[0xA5; 8]));
        rig.network.run_for(Time::from_us(500));
    }
    rig.network.adapter_mut(disturber).close();
}

#[test]
fn errors_soon_after_a_search_without_a_result_begin_another() {
    let mut rig = node_40(0);
    let disturber = rig.add_disturber();
    rig.network.adapter_mut(rig.master).close();
    for _ in 0..3 {
        let since = rig.network.now();
        disturb(&mut rig, disturber, Time::from_ms(1_300));
        assert_ne!(rig.bit_rates(0, since), []);
        rig.network.run_for(Time::from_ms(1_000));
    }
    rig.network.adapter_mut(rig.master).open();
    assert!(rig.is_reached());
}

#[test]
fn a_full_queue_drops_the_latest_messages() {
    let mut rig = slow_node_40(60);
    // Each lost frame is reported, but the commands go first.
    for _ in 0..600 {
        rig.queue(&frames::command("01 7F"));
    }
    rig.collect(Time::from_ms(100));
    let text = "CAN: the transmit queue is full, frame 0xc0 was dropped";
    assert!(rig.has_logged(text), "{:#?}", rig.network.board(0).log());
    assert!(rig.is_reached());
}

#[test]
fn bus_off_may_begin_while_the_indicators_are_set() {
    /// Of the blinking green indicator, whose step ends with the output.
    const RUN: Pin = Pin('D', 12);
    let mut rig = slow_node_40(5);
    let is_lit = |rig: &ImageRig| rig.network.board(0).output(RUN).level == Some(true);
    let mut to_bus_off = Time::ZERO;
    let begin = rig.network.now();
    // The first time only shows how long it takes.
    for before in [None].into_iter().chain((16..48).map(|step| Some(Time::from_ps(500_000 * step))))
    {
        let was_lit = is_lit(&rig);
        while is_lit(&rig) == was_lit {
            rig.network.run_for(Time::from_us(5));
        }
        if let Some(before) = before {
            rig.network.run_for(Time::from_ms(200) - before - to_bus_off);
        }
        let since = rig.network.now();
        rig.queue(&sdo::request(NODE_ID, "40 00 10 00"));
        rig.network.run_for(Time::from_us(140));
        rig.network.set_short(Some(Short::Recessive));
        rig.network.run_for(Time::from_ms(5));
        rig.network.set_short(None);
        let bus_off = rig.did(0, since).find(|event| event.what == What::BusOff);
        to_bus_off = bus_off.expect("it goes bus-off").time - since;
        rig.network.run_for(Time::from_ms(300));
    }
    assert!(rig.bit_rates(0, begin).iter().all(|(_, rate)| *rate == bit_per_s(RATE)));
    rig.lss("04 01");
    assert_eq!(rig.lss("5E"), ["5E 40"]);
}
