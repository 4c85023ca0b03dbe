//! The supervision of the release image at moments that are rare.

use canopen_node::BitRate;
use emulator::{
    Time,
    board::{self, Board},
    can::{Adapter, Frame, Id},
    chip::{Access, ChipVariant, Width},
    network::{Short, What},
};
use testkit::frames;

use crate::{
    rig::{
        ImageRig, SETTINGS_OFFSET, bit_per_s, board_with, flash_with, image, part, rig_with,
        settings,
    },
    uptime::booted_at,
};

const RATE: BitRate = BitRate::Kbit1000;
const OTHER_RATE: BitRate = BitRate::Kbit250;

/// A node with a core that is 40 times slower, at another rate than the master.
fn slow_node() -> ImageRig {
    let chip_variant = ChipVariant { slowdown: 40, ..ChipVariant::default() };
    let of_board = board::Settings { chip_variant, ..Default::default() };
    let mut board = Board::new(part(), image(), of_board);
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[settings(0x40, OTHER_RATE)]));
    let mut rig = ImageRig::new(RATE, [board]);
    rig.collect(Time::from_ms(100));
    rig
}

/// Makes the bus dominant for a while.
fn hold_dominant(rig: &mut ImageRig, span: Time) {
    rig.network.set_short(Some(Short::Dominant));
    rig.network.run_for(span);
    rig.network.set_short(None);
}

fn is_silent(rig: &ImageRig) -> bool {
    rig.network.board(0).chip().can(1).is_silent()
}

#[test]
fn a_guest_may_become_error_passive_by_the_error_that_sends_it_home() {
    let mut rig = slow_node();
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
    let mut rig = slow_node();
    // A boot-up does not end a search.
    let boot_up = canopen_node::Frame::new(0x702, &[0]).expect("a frame");
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

/// Node 40 at 1000 kbit/s, just powered on, with a master at 250 kbit/s.
fn at_a_wrong_rate() -> ImageRig {
    let settings = settings(0x40, BitRate::Kbit1000).with_heartbeat_ms(100);
    ImageRig::new(BitRate::Kbit250, [board_with(0, settings)])
}

/// The same, which has become a guest at the rate of the master.
fn guest() -> ImageRig {
    let mut rig = at_a_wrong_rate();
    assert!(rig.is_reached());
    rig
}

#[test]
fn a_guest_goes_home_when_its_master_is_gone() {
    let mut rig = guest();
    rig.network.adapter_mut(rig.master).close();
    rig.network.run_for(Time::from_s(10));
    rig.network.adapter_mut(rig.master).open();
    rig.set_master_bit_rate(BitRate::Kbit1000);
    assert!(rig.is_reached());
}

#[test]
fn a_dominant_bus_ends_a_search_and_not_the_stay_of_a_guest() {
    let mut rig = guest();
    rig.network.set_short(Some(Short::Dominant));
    rig.network.run_for(Time::from_s(3));
    rig.network.set_short(None);
    assert!(rig.is_reached());
    for ms in [5, 40, 90, 130, 180, 230, 300, 400] {
        let mut rig = at_a_wrong_rate();
        rig.network.run_for(Time::from_ms(ms));
        rig.network.set_short(Some(Short::Dominant));
        rig.network.run_for(Time::from_ms(600));
        rig.network.set_short(None);
        rig.set_master_bit_rate(BitRate::Kbit1000);
        assert!(rig.is_reached());
    }
}

#[test]
fn a_request_during_the_pause_of_a_lonely_board_is_answered() {
    let mut unanswered = 0;
    for delay in 0..12 {
        let mut rig = rig_with(settings(0x40, BitRate::Kbit1000).with_heartbeat_ms(50));
        rig.network.adapter_mut(rig.master).close();
        rig.power_cycle(0);
        rig.network.run_for(Time::from_ms(50 + 60 * delay));
        rig.network.adapter_mut(rig.master).open();
        rig.queue(&frames::request("04 01"));
        rig.queue(&frames::request("5E"));
        let answers = rig.collect(Time::from_ms(100)).texts();
        unanswered += u32::from(!answers.iter().any(|text| text.starts_with("7E4: 5E")));
    }
    assert_eq!(unanswered, 0);
}

#[test]
fn a_board_that_switched_alone_returns_to_the_bus_at_the_old_rate() {
    let rate = BitRate::Kbit125;
    let mut rig = rig_with(settings(1, rate).with_heartbeat_ms(50));
    let other = rig.network.add_adapter(Adapter::new(bit_per_s(rate)));
    rig.transmit_request("04 01");
    rig.lss("13 00 02");
    rig.transmit_request("15 0A 00");
    // For 30 s only the commanded rate counts.
    rig.network.run_for(Time::from_s(29));
    let busy_until = rig.network.now() + Time::from_s(3);
    while rig.network.now() < busy_until {
        rig.network.send(other, Frame::data(Id::Standard(0x123), &[0; 8]));
        rig.network.run_for(Time::from_us(1_500));
    }
    assert!(rig.network.trace().iter().any(|event| matches!(event.what, What::Error { .. })));
    rig.collect(Time::from_ms(10));
    rig.lss("04 01");
    let answers = rig.lss("5E");
    assert!(answers.0.iter().any(|frame| frames::text(frame).starts_with("7E4: 5E 01")));
}

#[test]
fn a_board_searches_and_visits_home_whatever_the_count() {
    for count in [0, 0x4000_0000, 0x8000_0000, 0xC000_0000, (-3_000_000_i32).cast_unsigned()] {
        let mut rig = booted_at(count, BitRate::Kbit250);
        assert!(rig.is_reached(), "{count:X}: at the rate of the others");
        rig.set_master_bit_rate(BitRate::Kbit1000);
        assert!(rig.is_reached(), "{count:X}: at home again");
    }
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

#[test]
fn a_boot_up_that_is_repeated_after_half_an_hour_restarts_the_heartbeat() {
    let mut rig = rig_with(settings(0x40, RATE).with_heartbeat_ms(1000));
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
