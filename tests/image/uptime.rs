//! The release image after long uptimes: the count of milliseconds in its RAM is set while it boots, so that the
//! 32 bits of the node's microseconds (71.6 minutes) and of milliseconds (49.7 days) wrap soon after. No count is
//! longer.

use emulator::{
    Time,
    network::{Event, What},
};
use lss_slave::BitRate;
use testkit::{
    image::image,
    image_rig::{ImageRig, board_with, settings},
};

/// The time after power-on at which the program waits for its crystal: its variables are set up, its clock is stopped.
const WAITS_FOR_CRYSTAL: Time = Time::from_us(1_800);
/// The middle of the session in ms after power-on; every counter that can wrap does so there.
const MIDDLE_MS: u64 = 1_000;
const MINUTES_71: u64 = (1 << 32) / 1000;
const DAYS_49: u64 = 1 << 32;
/// The uptime after 4290 wraps of the milliseconds.
const YEARS_584: u64 = 584 * 8766 * 3_600_000;

fn count_address() -> u32 {
    image().symbol_containing("clock5TICKS").expect("the count of milliseconds")
}

fn count(bench: &ImageRig) -> u32 {
    let mut bytes = [0; 4];
    assert!(bench.network.board(0).read_memory(count_address(), &mut bytes));
    u32::from_le_bytes(bytes)
}

/// Node 40 with a heartbeat on a board that has counted a number of milliseconds when it boots.
fn booted_at(count_ms: u32) -> ImageRig {
    let stored = settings(0x40, BitRate::Kbit1000).with_heartbeat_ms(30);
    let mut board = board_with(0, stored);
    board.run_until(WAITS_FOR_CRYSTAL);
    assert!(board.write_memory(count_address(), &count_ms.to_le_bytes()));
    ImageRig::new(BitRate::Kbit1000, [board])
}

/// Requests, a store, a switch of the bit rate whose delays last over the middle, heartbeats; returns all events.
fn session(count_ms: u32) -> Vec<Event> {
    let mut bench = booted_at(count_ms);
    for request in ["04 01", "5A", "11 04", "17"] {
        bench.lss(request);
        bench.network.run_for(Time::from_ms(100));
    }
    bench.lss("13 00 02");
    bench.network.run_until(Time::from_ms(MIDDLE_MS - 300));
    bench.transmit_request("15 C8 00");
    bench.network.run_for(Time::from_ms(200));
    bench.set_master_bit_rate(BitRate::Kbit500);
    bench.network.run_until(Time::from_ms(MIDDLE_MS + 300));
    assert!(!bench.lss("5E").0.is_empty());
    bench.network.run_until(Time::from_ms(2 * MIDDLE_MS));
    let passed = u64::from(count(&bench).wrapping_sub(count_ms));
    assert!((2 * MIDDLE_MS - 20..2 * MIDDLE_MS).contains(&passed), "{passed} ms");
    bench.network.trace().to_vec()
}

#[test]
fn a_wrap_of_any_count_of_time_changes_nothing_that_the_board_does() {
    let young = session(0);
    let heartbeats = young.iter().filter(|event| {
        matches!(event.what, What::Frame { frame, .. } if frame.id == emulator::can::Id::Standard(0x740))
    });
    assert!(heartbeats.count() > 30, "{young:#?}");
    for (uptime, wrap) in
        [("71.6 minutes", MINUTES_71), ("49.7 days", DAYS_49), ("584 years", YEARS_584)]
    {
        let old = session((wrap - MIDDLE_MS) as u32);
        assert_eq!(old.len(), young.len(), "{uptime}");
        for (old, young) in old.iter().zip(&young) {
            let apart = old.time.as_ps().abs_diff(young.time.as_ps());
            let is_same = old.source == young.source && same(&old.what, &young.what);
            assert!(is_same && apart <= 2_000_000, "{uptime}: {old}, not {young}");
        }
    }
}

/// Whether two events are the same except for the time.
fn same(a: &What, b: &What) -> bool {
    match (a, b) {
        (What::Frame { frame: a, .. }, What::Frame { frame: b, .. }) => a == b,
        _ => a == b,
    }
}
