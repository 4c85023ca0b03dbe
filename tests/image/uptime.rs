//! The release image after a long uptime: its count of microseconds is set while it boots, so that the 32 bits wrap
//! soon after. No count is longer.

use emulator::chip::{Access, Width};

use crate::rig::*;

/// TIM2's control register and its counter (RM0090, 18.4).
const TIM2_CR1: u32 = 0x4000_0000;
const TIM2_CNT: u32 = 0x4000_0024;
/// The middle of the session in ms after power-on, where the count wraps.
const MIDDLE_MS: u64 = 1_000;

fn access(board: &Board, address: u32) -> Access {
    Access { address, width: Width::Word, now: board.now(), pc: 0 }
}

fn read(board: &Board, address: u32) -> u32 {
    board.chip().read(access(board, address)).expect("a register")
}

/// Node 40 with a heartbeat on a board that has counted a number of microseconds when it boots.
pub fn booted_at(count: u32, bus: BitRate) -> ImageRig {
    let with_heartbeat = settings(0x40, BitRate::Kbit1000).with_heartbeat_ms(50);
    let mut board = board_with(0, with_heartbeat);
    let is_counting = |board: &Board| {
        const APB1ENR: u32 = 0x4002_3840;
        read(board, APB1ENR) & 1 == 1 && read(board, TIM2_CR1) & 1 == 1
    };
    while !is_counting(&board) {
        assert!(board.now() < Time::from_ms(20), "the timer does not start");
        let next = board.now() + Time::from_us(1);
        board.run_until(next);
    }
    let counter = access(&board, TIM2_CNT);
    board.chip().write(counter, count).expect("a register");
    ImageRig::new(bus, [board])
}

/// Requests, a store, a switch of the bit rate whose delays last over the middle, heartbeats; returns all events.
fn session(count: u32) -> Vec<Event> {
    let mut rig = booted_at(count, BitRate::Kbit1000);
    for request in ["04 01", "5A", "11 04", "17"] {
        rig.lss(request);
        rig.network.run_for(Time::from_ms(100));
    }
    rig.lss("13 00 02");
    rig.network.run_until(Time::from_ms(MIDDLE_MS - 300));
    rig.transmit_request("15 C8 00");
    rig.network.run_for(Time::from_ms(200));
    rig.set_master_bit_rate(BitRate::Kbit500);
    rig.network.run_until(Time::from_ms(MIDDLE_MS + 300));
    assert!(!rig.lss("5E").0.is_empty());
    rig.network.run_until(Time::from_ms(2 * MIDDLE_MS));
    let passed = read(rig.network.board(0), TIM2_CNT).wrapping_sub(count);
    let expected = 2 * MIDDLE_MS as u32 * 1000;
    assert!((expected - 20_000..expected).contains(&passed), "{passed} us");
    rig.network.trace().to_vec()
}

#[test]
fn a_wrap_of_the_count_of_time_changes_nothing_that_the_board_does() {
    let young = session(0);
    let heartbeats = young.iter().filter(
        |event| matches!(event.what, What::Frame { frame, .. } if frame.id == Id::Standard(0x740)),
    );
    assert!(heartbeats.count() > 30, "{young:#?}");
    let old = session((MIDDLE_MS as u32 * 1000).wrapping_neg());
    assert_eq!(old.len(), young.len());
    for (old, young) in old.iter().zip(&young) {
        let apart = old.time.as_ps().abs_diff(young.time.as_ps());
        let is_same = old.source == young.source && same(&old.what, &young.what);
        assert!(is_same && apart <= 2_000_000, "{old}, not {young}");
    }
}

/// Whether two events are the same except for the time.
fn same(a: &What, b: &What) -> bool {
    match (a, b) {
        (What::Frame { frame: a, .. }, What::Frame { frame: b, .. }) => a == b,
        _ => a == b,
    }
}

/// Passes time that the board does not notice but in its count, and sends a request, whose interrupt sets the next
/// deadline. To the board that is a halt of its core: it ignores the frame that ends it.
pub fn skip_40_minutes(rig: &mut ImageRig, request: &canopen_node::Frame) {
    let board = rig.network.board(0);
    let count = read(board, TIM2_CNT).wrapping_add(40 * 60_000_000);
    board.chip().write(access(board, TIM2_CNT), count).expect("a register");
    rig.queue(&frames::request("04 00"));
    rig.queue(request);
}

#[test]
fn heartbeats_go_on_after_more_than_half_an_hour_without_one() {
    let mut rig = node_40(0);
    skip_40_minutes(&mut rig, &sdo::request(0x40, "2B 17 10 00 14"));
    for _ in 0..2 {
        rig.collect(Time::from_ms(25));
        assert_eq!(rig.collect(Time::from_ms(60)).texts(), ["740: 7F"; 3]);
        skip_40_minutes(&mut rig, &sdo::request(0x40, "40 17 10 00"));
    }
}
