//! The release image at moments that are rare: a deadline, a reset, a wrap of the time or a dominant bus in the middle of
//! something else. `cargo xtask coverage` shows the branches that only they take.

use emulator::{
    Time,
    board::{self, Board},
    can::{Adapter, Frame, Id},
    chip::{Access, Readings, Width},
    network::{AdapterId, Short, What},
};
use lss_slave::{BitRate, BitRateSetting, Settings};
use testkit::{
    frames::{self, Frames},
    image::{image, part},
    image_rig::{ImageRig, SETTINGS_OFFSET, bit_per_s, flash_with, on_the_wire, settings},
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

fn queue(rig: &mut ImageRig, frame: &lss_slave::Frame) {
    rig.network.send(rig.master, on_the_wire(frame));
}

fn texts(frames: &Frames) -> Vec<String> {
    frames.0.iter().map(frames::text).collect()
}

/// Selects the board and inquires its node-ID every 50 ms; returns whether it answers within 15 s.
fn is_reached(rig: &mut ImageRig) -> bool {
    (0..300).any(|_| {
        queue(rig, &frames::request("04 01"));
        queue(rig, &frames::request("5E"));
        let frames = rig.collect(Time::from_ms(50));
        frames.0.iter().any(|frame| frame.cob_id() == 0x7E4)
    })
}

/// Passes time that the board does not notice but in its count.
fn skip_minutes(rig: &ImageRig, minutes: u32) {
    const TIM2_CNT: u32 = 0x4000_0024;
    let board = rig.network.board(0);
    let counter = Access { address: TIM2_CNT, width: Width::Word, now: board.now(), pc: 0 };
    let count = board.chip().read(counter).expect("a register");
    board.chip().write(counter, count.wrapping_add(minutes * 60_000_000)).expect("a register");
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
    rig.network.run_for(Time::from_ms(250));
    skip_minutes(&rig, 40);
    rig.network.adapter_mut(rig.master).open();
    queue(&mut rig, &frames::stranger());
    rig.collect(Time::from_ms(200));
    queue(&mut rig, &frames::request("04 01"));
    let sent = rig.collect(Time::from_ms(1_000));
    assert_eq!(texts(&sent), ["740: 7F"]);
}

#[test]
fn a_guest_goes_home_at_any_time_of_its_count() {
    for minutes in [0, 40] {
        let mut rig = node_40(100);
        skip_minutes(&rig, minutes);
        rig.set_master_bit_rate(OTHER_RATE);
        assert!(is_reached(&mut rig));
        rig.network.adapter_mut(rig.master).close();
        rig.network.run_for(Time::from_s(10));
        rig.network.adapter_mut(rig.master).open();
        rig.set_master_bit_rate(RATE);
        assert!(is_reached(&mut rig), "{minutes} minutes");
    }
}

#[test]
fn errors_far_apart_do_not_start_a_search() {
    let mut rig = node_40(0);
    rig.nmt("01 00");
    let since = rig.network.now();
    for seconds in [3, 1, 3, 1, 1] {
        hold_dominant(&mut rig, Time::from_us(10));
        rig.network.run_for(Time::from_s(seconds));
    }
    assert_eq!(rig.bit_rates(0, since), []);
    assert!(is_reached(&mut rig));
}

#[test]
fn a_reset_leaves_a_save_unanswered_whose_end_waits_behind_errors() {
    let mut rig = node_40(0);
    queue(&mut rig, &sdo::request(NODE_ID, "2B 17 10 00 E8 03"));
    queue(&mut rig, &sdo::request(NODE_ID, "23 10 10 01 73 61 76 65"));
    rig.network.run_for(Time::from_us(300));
    hold_dominant(&mut rig, Time::from_us(300));
    rig.network.run_for(Time::from_ms(3));
    rig.collect(Time::ZERO);
    queue(&mut rig, &frames::command("82 40"));
    assert_eq!(texts(&rig.collect(Time::from_ms(20))), ["740: 00"]);
    rig.power_cycle(0);
    rig.collect(Time::from_ms(1_100));
    assert_eq!(texts(&rig.collect(Time::from_ms(1_000))), ["740: 7F"]);
}

/// An adapter at the bit rate that drops out now and then, so that it is never error passive.
fn send_and_leave(rig: &mut ImageRig, adapter: AdapterId, rate: BitRate) {
    let frame = Frame::data(Id::Standard(0x181), &[0xAA; 8]);
    rig.network.adapter_mut(adapter).open();
    rig.network.send(adapter, frame);
    rig.network.run_for(Time::from_ps(8 * 130 * 1_000_000_000 / u64::from(bit_per_s(rate) / 1000)));
    rig.network.adapter_mut(adapter).close();
}

#[test]
fn a_listener_leaves_a_rate_with_form_errors_only() {
    let stored = settings(NODE_ID, RATE).with_bit_rate(BitRateSetting::Automatic);
    let mut rig = rig(Readings::default(), stored);
    rig.network.adapter_mut(rig.master).close();
    let other = rig.network.add_adapter(Adapter::new(bit_per_s(RATE)));
    let since = rig.network.now();
    for _ in 0..6 {
        send_and_leave(&mut rig, other, RATE);
    }
    assert_ne!(rig.bit_rates(0, since), []);
    rig.network.adapter_mut(rig.master).open();
    assert!(is_reached(&mut rig));
}

#[test]
fn a_listener_finds_the_rate_by_remote_frames_or_29_bit_frames() {
    let stored = settings(NODE_ID, RATE).with_bit_rate(BitRateSetting::Automatic);
    for id in [Id::Standard(0x181), Id::Extended(0x181)] {
        let mut rig = rig(Readings::default(), stored);
        let other = rig.network.add_adapter(Adapter::new(bit_per_s(RATE)));
        let frame = Frame { remote: matches!(id, Id::Standard(_)), ..Frame::data(id, &[]) };
        rig.network.send(other, frame);
        assert_eq!(texts(&rig.collect(Time::from_ms(50))), ["740: 00"], "{frame}");
    }
}

#[test]
fn lss_answers_outlive_a_change_of_the_node_id() {
    let mut rig = slow_node_40(30);
    rig.lss("04 01");
    for request in ["11 41", "5A", "5B"] {
        queue(&mut rig, &frames::request(request));
    }
    queue(&mut rig, &frames::command("82 00"));
    let sent = texts(&rig.collect(Time::from_ms(50)));
    let ids: Vec<&str> = sent.iter().map(|text| &text[..6]).collect();
    assert_eq!(ids, ["7E4: 1", "7E4: 5", "7E4: 5", "741: 0"]);
}

#[test]
fn a_dominant_bus_ends_a_search_in_each_of_its_turns() {
    let mut turns = [false; 2];
    for ms in (0..400).step_by(25) {
        let mut rig = node_40(100);
        rig.set_master_bit_rate(OTHER_RATE);
        for _ in 0..60 {
            queue(&mut rig, &frames::stranger());
            rig.network.run_for(Time::from_ms(20));
        }
        rig.network.adapter_mut(rig.master).close();
        rig.network.run_for(Time::from_ms(ms));
        turns[usize::from(rig.network.board(0).chip().can(1).is_silent())] = true;
        hold_dominant(&mut rig, Time::from_ms(600));
        rig.network.adapter_mut(rig.master).open();
        rig.set_master_bit_rate(RATE);
        assert!(is_reached(&mut rig));
    }
    assert_eq!(turns, [true; 2]);
}
