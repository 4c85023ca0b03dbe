//! Process data where no case can look: switches of the bit rate, drops, late calls, and what an application does.

use canopen_node::{
    Action, Application, BusEvent, Frame, Instant, Service, Services, objects, pdo::Rpdo,
};
use testkit::{
    flash::BoardFlash,
    frames::SILENCE,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::Client,
};

use crate::process_data::{
    Board, INVALID_VALUE, Machine, board, change, map, operational, receive, set, take_events,
    write,
};

/// Lamps and speed.
fn outputs(board: &Board) -> (u8, u16) {
    (board.node.application().lamps, board.node.application().speed)
}

#[test]
fn a_dummy_entry_leaves_out_its_bytes() {
    let mut board = operational();
    receive(&mut board, "340: FF FF 44 33 22 11");
    receive(&mut board, "080:");
    assert_eq!(board.node.application().command, 0x1122_3344);
}

#[test]
fn an_rpdo_that_is_invalid_or_empty_has_no_effect() {
    let mut board = operational();
    set(&mut board, 0x1400, 1, 0x8000_0240, 4);
    assert_eq!(receive(&mut board, "240: 05 00 00"), SILENCE);
    map(&mut board, 0x1400, 0x240, &[]);
    assert_eq!(receive(&mut board, "240: 05 00 00"), SILENCE);
    assert_eq!((outputs(&board), take_events().len()), ((0, 0), 0));
}

#[test]
fn the_cob_id_of_sync_can_be_moved_but_the_node_is_no_producer() {
    let mut board = operational();
    assert_eq!(board.number(0x1005, 0), 0x80);
    for value in [0x4000_0080, 0x2000_0080, 0x0000_07FF, 0] {
        assert_eq!(write(&mut board, 0x1005, 0, value, 4), Err(INVALID_VALUE), "{value:X}");
    }
    set(&mut board, 0x1005, 0, 0x8000_0100, 4);
    assert_eq!(board.number(0x1005, 0), 0x100, "bit 31 has no meaning");
    assert_eq!(receive(&mut board, "080:"), SILENCE);
    assert_eq!(receive(&mut board, "100:").0.len(), 1);
}

#[test]
fn a_value_that_a_client_writes_is_sent_after_the_answer() {
    let mut board = board();
    map(&mut board, 0x1802, 0x3C0, &[0x6200_0108]);
    board.nmt("01 40");
    let frames = board.sdo("2F 00 62 01 09");
    assert_eq!(frames, ["5C0: 60 00 62 01 00 00 00 00", "3C0: 09"]);
}

#[test]
fn a_guest_at_another_bit_rate_sends_no_pdos_until_it_is_home() {
    let device = device(ADDRESS).with_defaults(defaults(0x40)).with_rescue(true);
    let mut board: Board =
        NodeRig::with_application(device, BoardFlash::blank(0), 0, Machine::new());
    board.is_acknowledged = false;
    board.power_cycle();
    board.see(BusEvent::Error);
    board.is_acknowledged = true;
    board.see(BusEvent::Received);
    assert_eq!(board.sdo("40 00 10 00").0.len(), 3, "boot-up, answer and emergency");
    set(&mut board, 0x1017, 0, 10, 2);
    set(&mut board, 0x1800, 5, 10, 2);
    board.nmt("01 40");
    for _ in 0..10 {
        assert_eq!(change(&mut board, |machine| machine.level += 1), SILENCE);
        assert_eq!(receive(&mut board, "080:"), SILENCE);
        assert_eq!(board.pass_ms(1_000), SILENCE);
    }
    let sent = board.pass_ms(5_000).texts();
    for text in ["740: 05", "1C0: 00 0A 00"] {
        assert!(sent.iter().any(|frame| frame == text), "{text}");
    }
}

#[test]
fn the_end_of_operational_drops_what_names_it_or_is_forbidden() {
    let pre_operational = Services::of(Service::Tpdo);
    let stopped = Services::of_all(&[Service::Emergency, Service::Sdo]).and(pre_operational);
    for (end, forbidden) in
        [("80 40", pre_operational), ("02 40", stopped), ("80 00", pre_operational)]
    {
        let mut board = operational();
        board.take_actions();
        board.nmt(end);
        assert_eq!(board.take_actions(), [Action::Drop(forbidden)], "{end}");
        board.nmt(end);
        assert_eq!(board.take_actions(), [], "they have been dropped");
    }
    let mut board = operational();
    board.take_actions();
    board.see(BusEvent::BusOff);
    assert_eq!(board.take_actions(), [Action::Drop(pre_operational)]);
}

#[test]
fn an_acknowledge_amid_the_calls_of_poll_leaves_no_tpdo_out() {
    let mut board = operational();
    set(&mut board, 0x1017, 0, 10_000, 2);
    board.configure("13 00 00, 15 0A 00");
    board.pass_ms(19);
    let end = Instant::from_micros(board.now() as u32).plus_micros(1_000);
    let heartbeat = Frame::new(0x740, &[5]).expect("a frame");
    assert_eq!(board.node.poll(end), Some(Action::Transmit(heartbeat, Service::Heartbeat)));
    board.node.handle_sent(Services::ALL, end);
    let tpdo = Frame::new(0x1C0, &[0; 3]).expect("a frame");
    assert_eq!(board.node.poll(end), Some(Action::Transmit(tpdo, Service::Tpdo)));
}

/// A board in NMT operational that has just sent TPDO 1, which has an inhibit time of 10 ms.
fn inhibited_for_10_ms() -> Board {
    let mut board = board();
    set(&mut board, 0x1800, 1, 0x8000_01C0, 4);
    set(&mut board, 0x1800, 3, 100, 2);
    set(&mut board, 0x1800, 1, 0x1C0, 4);
    assert_eq!(board.nmt("01 40"), ["1C0: 00 00 00"]);
    board
}

#[test]
fn an_inhibit_time_that_nobody_has_looked_at_for_any_time_is_over() {
    // Not valid, and synchronous.
    for (end, begin) in [
        ("23 00 18 01 C0 01 00 80", "23 00 18 01 C0 01 00 00"),
        ("2F 00 18 02 01", "2F 00 18 02 FF"),
    ] {
        for minutes in [1, 35, 36, 40, 60, 71, 72, 108] {
            let mut board = inhibited_for_10_ms();
            board.sdo(end);
            board.pass_ms(minutes * 60_000);
            let frames = board.sdo(begin);
            assert_eq!(
                frames.0.len(),
                2,
                "{minutes} minutes: the answer and the PDO, not {frames:?}"
            );
        }
    }
}

#[test]
fn a_cob_id_reads_as_it_was_written() {
    for (index, id) in [(0x1800, 0x1C0), (0x1400, 0x240)] {
        for bits in [0, 0x4000_0000, 0x8000_0000, 0xC000_0000] {
            let mut board = board();
            set(&mut board, index, 1, 0x8000_0000 | bits | id, 4);
            assert_eq!(board.number(index, 1), 0x8000_0000 | bits | id);
            set(&mut board, index, 1, bits | id, 4);
            assert_eq!(board.number(index, 1), bits | id);
            board.sdo("23 10 10 01 73 61 76 65");
            board.power_cycle();
            assert_eq!(board.number(index, 1), bits | id, "after a store");
        }
    }
}

#[test]
fn nothing_is_sent_in_the_delays_of_a_switch_and_the_latest_data_after() {
    let mut board = board();
    set(&mut board, 0x1800, 5, 30, 2);
    board.nmt("01 40");
    board.configure("13 00 02, 15 64");
    assert_eq!(change(&mut board, |machine| machine.buttons = 1), SILENCE);
    assert_eq!(receive(&mut board, "080:"), SILENCE);
    assert_eq!(receive(&mut board, "240: 05 00 00"), SILENCE);
    assert_eq!(board.pass_ms(199), SILENCE);
    assert_eq!(board.pass_ms(1), ["1C0: 01 00 00"]);
    assert_eq!(board.node.application().lamps, 0, "a PDO of the silence has no effect");
    assert_eq!(board.pass_ms(29), SILENCE);
    assert_eq!(board.pass_ms(1), ["1C0: 01 00 00"]);
}

const LATE: &str = "0C0: 50 82 11 01 00 00 00 00";
const RIGHT: &str = "240: 05 00 00";

/// A board in NMT operational whose RPDO 1 must come each 100 ms.
fn watching() -> Board {
    let mut board = operational();
    set(&mut board, 0x1400, 5, 100, 2);
    board
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
