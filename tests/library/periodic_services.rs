//! The limit of the periodic services, the heartbeat and the event timers of TPDOs: one frame waits at a time, and half
//! of the bus is left to others.

use canopen_node::{BitRate, BusEvent, Frame, Service};
use testkit::{
    flash::BoardFlash,
    frames::SILENCE,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::Client,
};

use crate::process_data::{Board, Machine, change, map, set};

/// A board at 10 kbit/s with a machine, in NMT operational: a heartbeat every 5 ms, and three TPDOs with an event timer
/// of 1 ms, of 3, 8 and 1 bytes.
fn hurried() -> Board {
    let settings = defaults(0x40).with_bit_rate(BitRate::Kbit10.into());
    let device = device(ADDRESS).with_defaults(settings).with_heartbeat_ms(5);
    let mut board = NodeRig::with_application(device, BoardFlash::blank(0), 0, Machine::new());
    map(&mut board, 0x1802, 0x3C0, &[0x6000_0108]);
    for index in [0x1800, 0x1801, 0x1802] {
        set(&mut board, index, 2, 255, 1);
        set(&mut board, index, 5, 1, 2);
    }
    board.nmt("01 40");
    board.take_actions();
    board
}

/// The shortest time that a frame takes at 10 kbit/s, in microseconds: without stuff bits.
fn micros(frame: &Frame) -> u64 {
    (47 + 8 * frame.data().len() as u64) * 100
}

#[test]
fn hurried_services_take_at_most_half_of_the_bus_and_each_its_share() {
    let mut board = hurried();
    let frames = board.pass_ms(10_000).0;
    let micros_on_bus: u64 = frames.iter().map(micros).sum();
    assert!((4_000_000..=5_000_000).contains(&micros_on_bus), "{micros_on_bus}");
    for cob_id in [0x740, 0x1C0, 0x2C0, 0x3C0] {
        let number = frames.iter().filter(|frame| frame.cob_id() == cob_id).count();
        assert!((120..=200).contains(&number), "{number} of {cob_id:03X} among {}", frames.len());
    }
}

#[test]
fn the_frame_before_must_have_left() {
    let mut board = hurried();
    board.pass_ms(100);
    board.is_acknowledged = false;
    assert_eq!(board.pass_ms(100).0.len(), 1);
    assert_eq!(board.pass_ms(10_000), SILENCE);
    assert_eq!(board.acknowledge(Service::Sdo), SILENCE, "it is another frame's");
    assert!(board.node.wants_to_send_more());
    assert_eq!(board.see(BusEvent::NonePending), SILENCE);
    assert_eq!(board.pass_ms(20).0.len(), 1);
    assert_eq!(board.pass_ms(10_000), SILENCE);
}

#[test]
fn a_heartbeat_waits_alone_on_a_bus_without_others() {
    let mut board = NodeRig::with_heartbeat(0x40, 100);
    board.is_acknowledged = false;
    assert_eq!(board.pass_ms(10_000), ["740: 7F"]);
    board.is_acknowledged = true;
    assert_eq!(board.see(BusEvent::NonePending), SILENCE);
    assert_eq!(board.pass_ms(99), SILENCE, "those that were due meanwhile are left out");
    assert_eq!(board.pass_ms(1), ["740: 7F"]);
}

#[test]
fn a_heartbeat_that_was_off_for_an_hour_begins_on_time() {
    let mut board = NodeRig::with_heartbeat(0x40, 100);
    assert_eq!(board.pass_ms(100), ["740: 7F"]);
    assert_eq!(board.download(0x1017, 0, &[0, 0]), Ok(()));
    assert_eq!(board.pass_ms(3_600_000), SILENCE);
    assert_eq!(board.download(0x1017, 0, &[100, 0]), Ok(()));
    assert_eq!(board.pass_ms(100), ["740: 7F"]);
}

#[test]
fn changes_and_syncs_are_sent_while_a_periodic_frame_waits() {
    let mut board = hurried();
    set(&mut board, 0x1801, 2, 1, 1);
    board.pass_ms(100);
    board.is_acknowledged = false;
    board.pass_ms(100);
    assert_eq!(change(&mut board, |machine| machine.level = 7), ["1C0: 00 07 00"]);
    let sync = Frame::new(0x080, &[]).expect("a frame");
    assert_eq!(board.receive(&sync), ["2C0: 00 00 00 00 00 00 00 00"]);
}

#[test]
fn periodic_services_that_fit_the_bus_keep_their_times() {
    let settings = defaults(0x40).with_bit_rate(BitRate::Kbit20.into());
    let mut board = NodeRig::with_heartbeat_and(settings, 10);
    board.take_actions();
    board.pass_ms(1_000);
    let times: Vec<_> = board.take_timed_actions().map(|(at, _)| at).collect();
    assert_eq!(times, (1..=100).map(|number| number * 10_000).collect::<Vec<_>>());
}
