//! Times that end the wait for process data: the event timer of RPDOs 1400h sub 5 (CiA 301, 7.5.2.35), and the
//! synchronous window 1007h with the communication cycle period 1006h (CiA 301, 7.5.2.6 and 7.5.2.7).

use canopen_node::{Application, Frame, Instant, application::Event, objects, pdo::Rpdo};
use testkit::{frames::SILENCE, node_rig::NodeRig, sdo::Client};

use crate::process_data::{
    Board, DEVICE_STATE, board, operational, receive, set, take_events, write,
};

const LATE: &str = "0C0: 50 82 11 01 00 00 00 00";
const NO_ERROR: &str = "0C0: 00 00 00 00 00 00 00 00";
const RIGHT: &str = "240: 05 00 00";

/// A board in NMT operational whose RPDO 1 must come each 100 ms.
fn watching() -> Board {
    let mut board = operational();
    set(&mut board, 0x1400, 5, 100, 2);
    board
}

#[test]
fn an_rpdo_that_does_not_come_in_time_is_8250_once_until_it_comes() {
    let mut board = watching();
    assert_eq!(board.pass_ms(10_000), SILENCE, "the first one begins it");
    for _ in 0..2 {
        receive(&mut board, RIGHT);
        take_events();
        assert_eq!(board.pass_us(99_999), SILENCE);
        assert_eq!(board.pass_us(1), [LATE]);
        assert_eq!(take_events(), [Event::Late(1)]);
        assert_eq!((board.number(0x1001, 0), board.number(0x1003, 1)), (0x11, 0x0001_8250));
        assert_eq!(board.pass_ms(10_000), SILENCE, "once");
        assert_eq!(receive(&mut board, RIGHT), [NO_ERROR]);
        assert_eq!(board.number(0x1001, 0), 0);
    }
}

#[test]
fn each_frame_of_the_rpdo_begins_the_time_again_if_its_length_is_right() {
    for transmission_type in [1, 255] {
        let mut board = watching();
        set(&mut board, 0x1400, 2, transmission_type, 1);
        for _ in 0..5 {
            receive(&mut board, RIGHT);
            assert_eq!(board.pass_ms(99), SILENCE);
        }
        assert_eq!(receive(&mut board, "240: 05"), ["0C0: 10 82 11 01 00 00 00 00"]);
        assert_eq!(board.pass_ms(1), [LATE], "a short one is none");
    }
}

#[test]
fn without_a_time_or_out_of_operational_no_rpdo_is_late() {
    let mut board = watching();
    receive(&mut board, RIGHT);
    board.nmt("80 40");
    assert_eq!(board.pass_ms(1000), SILENCE);
    board.nmt("01 40");
    receive(&mut board, RIGHT);
    set(&mut board, 0x1400, 5, 0, 2);
    receive(&mut board, RIGHT);
    assert_eq!(board.pass_ms(1000), SILENCE);
    set(&mut board, 0x1400, 5, 100, 2);
    receive(&mut board, RIGHT);
    assert_eq!(board.pass_ms(100), [LATE]);
    assert_eq!(board.nmt("80 40"), [NO_ERROR], "the watch has ended");
}

#[test]
fn a_switch_of_the_bit_rate_makes_no_rpdo_late() {
    let mut board = watching();
    receive(&mut board, RIGHT);
    board.configure("13 00 02, 15 C8 00");
    assert_eq!(board.pass_ms(1000), ["1C0: 00 00 00"], "it resumes");
    receive(&mut board, RIGHT);
    assert_eq!(board.pass_ms(100), [LATE]);
}

objects! {
    /// A valve that a master must command often.
    struct Valve, values ValveValue;

    0x6200 {
        0 "Opening" opening: u8 = 0, rw, mappable;
    }
}

impl Application for Valve {
    const RPDOS: &'static [Rpdo] = &[Rpdo::new(&[(0x6200, 0)]).with_event_timer(50)];
}

#[test]
fn a_product_declares_the_event_timer_of_an_rpdo_and_a_stored_one_replaces_it() {
    let mut board: NodeRig<Valve> = NodeRig::running(Valve::new());
    for (milliseconds, is_late) in [(50, true), (0, false), (70, true)] {
        if milliseconds != 50 {
            board.nmt("80 40");
            set(&mut board, 0x1400, 5, milliseconds, 2);
            assert_eq!(board.save(1), Ok(()));
            board.power_cycle();
        }
        assert_eq!(board.number(0x1400, 5), milliseconds);
        board.nmt("01 40");
        board.receive(&Frame::new(0x240, &[1]).unwrap());
        assert_eq!(board.pass_ms(49), SILENCE);
        board.pass_ms(21);
        assert_eq!(board.number(0x1001, 0) != 0, is_late, "{milliseconds} ms");
    }
}

/// Lamps after an RPDO at each SYNC: `window_us` is 1007h, the RPDO comes `after_us` its SYNC.
fn lamps_after_a_synchronous_rpdo(window_us: u32, after_us: u64) -> u8 {
    let mut board = operational();
    set(&mut board, 0x1400, 2, 1, 1);
    set(&mut board, 0x1007, 0, window_us, 4);
    receive(&mut board, "080:");
    board.pass_us(after_us);
    receive(&mut board, RIGHT);
    receive(&mut board, "080:");
    board.node.application().lamps
}

#[test]
fn a_synchronous_rpdo_behind_the_window_is_dropped() {
    for (window_us, after_us, lamps) in [
        (0, 1_000_000, 5),
        (10_000, 9_999, 5),
        (10_000, 10_000, 0),
        (10_000, 3_000_000_000, 0),
        (1_500_000, 1_499_999, 5),
        (1_500_000, 1_500_000, 0),
        (u32::MAX, 1_000_000, 5),
    ] {
        assert_eq!(lamps_after_a_synchronous_rpdo(window_us, after_us), lamps, "{window_us} us");
    }
}

#[test]
fn the_next_sync_opens_the_window_again_and_other_rpdos_have_none() {
    let mut board = operational();
    set(&mut board, 0x1007, 0, 1000, 4);
    receive(&mut board, "080:");
    board.pass_ms(5);
    receive(&mut board, "240: 07 00 00");
    assert_eq!(board.node.application().lamps, 7, "its type is 255");
    set(&mut board, 0x1400, 2, 1, 1);
    receive(&mut board, RIGHT);
    receive(&mut board, "080:");
    assert_eq!(board.node.application().lamps, 7);
    receive(&mut board, RIGHT);
    board.pass_ms(5);
    receive(&mut board, "080:");
    assert_eq!(board.node.application().lamps, 5, "in time, it takes effect at the next SYNC");
}

#[test]
fn a_tpdo_that_was_not_sent_in_the_window_is_dropped() {
    for (window_us, sent) in [(0, true), (2_000, false), (2_001, true)] {
        let mut board = operational();
        set(&mut board, 0x1007, 0, window_us, 4);
        let sync = Frame::new(0x080, &[]).unwrap();
        let now = Instant::from_micros(board.now() as u32);
        assert_eq!(board.node.handle_frame(&sync, now), None);
        let frames = board.be_late_ms(2);
        assert_eq!(frames.0.len(), usize::from(sent), "{window_us} us: {frames:?}");
        assert_eq!(receive(&mut board, "080:").0.len(), 1, "the next one is sent");
    }
}

#[test]
fn the_counter_of_sync_changes_only_without_a_period() {
    let mut board = board();
    for period in [1, 1000, u32::MAX] {
        set(&mut board, 0x1006, 0, period, 4);
        assert_eq!(board.number(0x1006, 0), period);
        assert_eq!(write(&mut board, 0x1019, 0, 10, 1), Err(DEVICE_STATE));
        set(&mut board, 0x1019, 0, 0, 1);
        set(&mut board, 0x1006, 0, 0, 4);
    }
    set(&mut board, 0x1019, 0, 10, 1);
    set(&mut board, 0x1006, 0, 1000, 4);
    assert_eq!(board.save(1), Ok(()));
    board.power_cycle();
    assert_eq!((board.number(0x1006, 0), board.number(0x1019, 0)), (1000, 10));
}
