//! TPDOs (CiA 301, 7.2.2): the frames, and the times at which they are sent.

use canopen_node::{Action, BusEvent, Frame, Instant, Service, Services};
use testkit::{
    flash::BoardFlash,
    frames::SILENCE,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::Client,
};

use crate::process_data::{Board, Machine, board, change, map, operational, receive, set};

#[test]
fn a_value_that_a_client_writes_is_sent_after_the_answer() {
    let mut board = board();
    map(&mut board, 0x1802, 0x3C0, &[0x6200_0108]);
    board.nmt("01 40");
    let frames = board.sdo("2F 00 62 01 09");
    assert_eq!(frames, ["5C0: 60 00 62 01 00 00 00 00", "3C0: 09"]);
}

#[test]
fn pdos_are_sent_in_operational_only() {
    let mut board = operational();
    for command in ["80 40", "02 40"] {
        board.nmt(command);
        assert_eq!(change(&mut board, |machine| machine.level += 1), SILENCE);
        assert_eq!(receive(&mut board, "080:"), SILENCE);
        board.nmt("01 40");
    }
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
fn a_change_within_the_inhibit_time_leaves_when_it_ends() {
    let mut board = inhibited_for_10_ms();
    assert_eq!(board.pass_ms(10), SILENCE);
    assert_eq!(change(&mut board, |machine| machine.buttons = 1), ["1C0: 01 00 00"]);
    for buttons in 2..=9 {
        assert_eq!(change(&mut board, |machine| machine.buttons = buttons), SILENCE);
        assert_eq!(board.pass_ms(1), SILENCE);
    }
    assert_eq!(board.pass_us(1_999), SILENCE);
    assert_eq!(board.pass_us(1), ["1C0: 09 00 00"], "after 10 ms, with the latest value");
    assert_eq!(board.pass_ms(1_000), SILENCE);
}

#[test]
fn parameters_that_are_written_leave_the_inhibit_time() {
    let writes = [
        &[(2, 254, 1)][..],
        &[(5, 50, 2)],
        &[(1, 0x1C0, 4)],
        &[(1, 0x8000_01C0, 4), (1, 0x1C0, 4)],
    ];
    for writes in writes {
        let mut board = inhibited_for_10_ms();
        board.pass_ms(20);
        assert_eq!(change(&mut board, |machine| machine.buttons = 1), ["1C0: 01 00 00"]);
        board.pass_ms(4);
        board.take_actions();
        for (sub_index, value, size) in writes {
            set(&mut board, 0x1800, *sub_index, *value, *size);
        }
        let is_pdo = |action: &Action| matches!(action, Action::Transmit(frame, _) if frame.cob_id() == 0x1C0);
        assert!(!board.actions().any(|action| is_pdo(&action)), "{writes:X?}");
        assert_eq!(board.pass_us(5_999), SILENCE, "{writes:X?}");
        assert_eq!(board.pass_us(1), ["1C0: 01 00 00"], "{writes:X?}");
    }
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
fn a_new_inhibit_time_counts_from_the_next_pdo_on() {
    let mut board = inhibited_for_10_ms();
    for (sub_index, value, size) in [(1, 0x8000_01C0, 4), (3, 200, 2)] {
        set(&mut board, 0x1800, sub_index, value, size);
    }
    assert_eq!(board.sdo("23 00 18 01 C0 01 00 00").0.len(), 2, "the answer and the PDO");
    assert_eq!(change(&mut board, |machine| machine.buttons = 1), SILENCE);
    assert_eq!(board.pass_us(19_999), SILENCE);
    assert_eq!(board.pass_us(1), ["1C0: 01 00 00"]);
}

#[test]
fn the_event_timer_sends_an_unchanged_pdo_and_starts_again_with_each() {
    let mut board = board();
    set(&mut board, 0x1800, 5, 50, 2);
    assert_eq!(board.nmt("01 40"), ["1C0: 00 00 00"]);
    assert_eq!(board.pass_ms(49), SILENCE);
    assert_eq!(board.pass_ms(1), ["1C0: 00 00 00"]);
    assert_eq!(board.pass_ms(30), SILENCE);
    assert_eq!(change(&mut board, |machine| machine.buttons = 1), ["1C0: 01 00 00"]);
    assert_eq!(board.pass_ms(49), SILENCE);
    assert_eq!(board.pass_ms(51).0.len(), 2);
    let frames = board.sdo("2B 00 18 05");
    assert_eq!(frames, ["5C0: 60 00 18 05 00 00 00 00", "1C0: 01 00 00"]);
    assert_eq!(board.pass_ms(1_000), SILENCE);
}

#[test]
fn each_nth_sync_asks_for_a_tpdo_of_type_n() {
    let mut board = operational();
    assert_eq!(receive(&mut board, "080:"), ["2C0: 00 00 00 00 00 00 00 00"]);
    set(&mut board, 0x1801, 2, 3, 1);
    board.node.application_mut().position = -2;
    assert_eq!(receive(&mut board, "080:"), SILENCE);
    assert_eq!(receive(&mut board, "080:"), SILENCE);
    assert_eq!(receive(&mut board, "080:"), ["2C0: FE FF FF FF FF FF FF FF"]);
    assert_eq!(receive(&mut board, "080:"), SILENCE);
    assert_eq!(change(&mut board, |machine| machine.position = 1), SILENCE);
}

#[test]
fn the_sync_with_the_start_value_is_regarded_as_the_first() {
    for (transmission_type, expected) in [(1, vec![4, 5, 6, 7, 8, 9, 10]), (2, vec![5, 7, 9])] {
        let mut board = board();
        set(&mut board, 0x1019, 0, 10, 1);
        set(&mut board, 0x1801, 1, 0x8000_02C0, 4);
        set(&mut board, 0x1801, 2, transmission_type, 1);
        set(&mut board, 0x1801, 6, 4, 1);
        set(&mut board, 0x1801, 1, 0x2C0, 4);
        board.nmt("01 40");
        let sent: Vec<_> = (1..=10)
            .filter(|counter| !receive(&mut board, &format!("080: {counter:02X}")).0.is_empty())
            .collect();
        assert_eq!(sent, expected, "type {transmission_type}");
    }
}

#[test]
fn a_pdo_that_becomes_valid_in_operational_is_sent() {
    let mut board = operational();
    set(&mut board, 0x1800, 1, 0x8000_01C0, 4);
    assert_eq!(change(&mut board, |machine| machine.buttons = 7), SILENCE);
    assert_eq!(
        board.sdo("23 00 18 01 C0 01 00 00"),
        ["5C0: 60 00 18 01 00 00 00 00", "1C0: 07 00 00"]
    );
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
