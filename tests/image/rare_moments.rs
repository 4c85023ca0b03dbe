//! The release image at moments that are rare: a deadline, a reset, a wrap of the time or a dominant bus in the middle
//! of something else. `cargo xtask coverage` shows the branches that only they take.

use emulator::{
    Time,
    board::{self, Board},
    can::{Adapter, Frame, Id},
    chip::{Access, Pin, Readings, Timing, Width},
    network::{Short, What},
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

fn is_silent(rig: &ImageRig) -> bool {
    rig.network.board(0).chip().can(1).is_silent()
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
fn a_deadline_of_a_search_may_pass_just_before_a_frame_is_handled() {
    let slow = Readings { slowdown: 40, ..Readings::default() };
    let mut rig = rig(slow, settings(NODE_ID, OTHER_RATE));
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
fn a_full_queue_drops_the_latest_messages() {
    let mut rig = slow_node_40(200);
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
