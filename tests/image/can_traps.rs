//! A release image on chips whose CAN controller deviates from the manual: it joins, and disturbs no other node.

use emulator::can::bxcan::{Acknowledge, CanVariant, TransmitLock};

use crate::rig::*;

/// The line to the transceiver, as in pins.rs.
const TRANSMIT: Pin = Pin('B', 9);

fn board(settings: Stored, can_variant: CanVariant) -> Board {
    board_of(board::Settings { can_variant, ..Default::default() }, settings)
}

fn listener() -> Stored {
    settings(0x40, BitRateSetting::Automatic)
}

/// Node 40 at 500 kbit/s with such a controller.
fn node_40_on(can_variant: CanVariant) -> ImageRig {
    let board = board(settings(0x40, BitRate::Kbit500), can_variant);
    let mut rig = ImageRig::new(BitRate::Kbit500, [board]);
    rig.collect(Time::from_ms(100));
    rig
}

/// Lets another node send for 3 s, and checks that the listener has found its rate.
fn let_it_listen(rig: &mut ImageRig) {
    let other = rig.network.add_adapter(Adapter::new(bit_per_s(BitRate::Kbit250)));
    for _ in 0..150 {
        rig.network.send(other, Frame::data(Id::Standard(0x181), &[0x5A; 8]));
        rig.network.run_for(Time::from_ms(20));
    }
    assert_eq!(rig.network.adapter_mut(other).unsent(), 0);
    rig.collect(Time::from_ms(200));
    assert!(answers(rig));
}

/// Checks that other nodes detect no error with the board if they detect none without it.
#[test]
fn a_listener_whose_transmit_pin_is_locked_never_holds_the_bus_dominant() {
    for (every, frame) in [(1, 1), (1, 3), (2, 1), (3, 2)] {
        let transmit_lock = Some(TransmitLock { every, frame });
        let variant = CanVariant { transmit_lock, ..CanVariant::default() };
        let mut rig = ImageRig::new(BitRate::Kbit250, [board(listener(), variant)]);
        let_it_listen(&mut rig);
        assert!(rig.errors().is_empty(), "{every} {frame}: {:#?}", rig.errors());
    }
}

#[test]
fn a_controller_that_acknowledges_nothing_for_a_while_is_tried_again() {
    let dead = CanVariant { acknowledge: Acknowledge::Lost { every: 1 }, ..CanVariant::default() };
    let mut rig = node_40_on(CanVariant::default());
    rig.lss("04 01, 13 00 03");
    rig.network.board(0).chip().can_mut(1).set_variant(dead);
    rig.activate(10);
    rig.network.run_for(Time::from_s(1));
    let text = "CAN: the controller does not enter initialisation mode";
    assert!(rig.has_logged(text));
    rig.network.board(0).chip().can_mut(1).set_variant(CanVariant::default());
    rig.set_master_bit_rate(BitRate::Kbit250);
    rig.network.run_for(Time::from_ms(300));
    assert!(answers(&mut rig));
}

#[test]
fn a_chip_is_reset_until_its_controller_acknowledges() {
    let dead = CanVariant { acknowledge: Acknowledge::Lost { every: 1 }, ..CanVariant::default() };
    let mut rig = node_40_on(CanVariant::default());
    rig.network.power_off(0);
    rig.network.board(0).chip().can_mut(1).set_variant(dead);
    rig.network.run_for(Time::from_ms(10));
    rig.network.permit_misuse();
    rig.network.power_on(0);
    rig.network.run_for(Time::from_ms(100));
    rig.network.board(0).chip().can_mut(1).set_variant(CanVariant::default());
    let since = rig.network.now();
    rig.boot(0, since);
    rig.network.forbid_misuse();
    let causes: Vec<_> = rig.network.board(0).resets().iter().map(|(_, cause)| *cause).collect();
    assert_eq!(causes[1], ResetCause::PowerOn);
    assert!(causes.len() > 4 && causes[2..].iter().all(|cause| *cause == ResetCause::Software));
    rig.collect(Time::from_ms(20));
    assert!(answers(&mut rig));
}

#[test]
fn each_frame_is_handled_once_though_the_fifo_shows_the_next_one_late() {
    let mut rig = node_40_on(CanVariant { late_release: true, ..CanVariant::default() });
    rig.lss("04 01");
    for request in ["5A", "5B", "5C", "5D", "5E"] {
        rig.queue(&frames::stranger());
        rig.queue(&frames::request(request));
    }
    let sent = rig.collect(Time::from_ms(50)).0;
    let services: Vec<u8> = sent.iter().map(|frame| frame.data()[0]).collect();
    assert_eq!(services, [0x5A, 0x5B, 0x5C, 0x5D, 0x5E]);
}

#[test]
fn a_board_joins_and_is_configured_under_each_other_reading() {
    let off = CanVariant::default();
    let lost = [2, 3, 4].map(|every| Acknowledge::Lost { every });
    let late = lost.into_iter().chain([1, 11].map(Acknowledge::Late));
    let others = [
        CanVariant { passive_errors_interrupt: true, ..off },
        CanVariant { bus_off_tec_overflows: true, ..off },
        CanVariant { both_fifos: true, ..off },
        CanVariant { late_choice: true, ..off },
    ];
    for variant in late.map(|acknowledge| CanVariant { acknowledge, ..off }).chain(others) {
        let mut rig = node_40_on(variant);
        assert!(answers(&mut rig), "{variant:?}");
        assert_eq!(rig.lss("11 41, 17"), ["11 00", "17 00"], "{variant:?}");
        rig.power_cycle(0);
        assert_eq!(rig.collect(Time::from_ms(20)), ["741: 00"], "{variant:?}");
    }
}

#[test]
fn a_listener_that_hears_nothing_of_a_dominant_bus_is_reset_now_and_then() {
    let mut rig = ImageRig::new(BitRate::Kbit250, [board(listener(), CanVariant::default())]);
    rig.network.set_short(Some(Short::Dominant));
    let since = rig.network.now();
    rig.network.run_for(Time::from_s(3));
    let resets = rig.did(0, since).filter(|event| event.what == What::InitializationEntered);
    let count = resets.count();
    // Four times a second, and at both new rounds of the detection.
    assert!((12..=14).contains(&count), "{count} in 3 s");
    rig.network.set_short(None);
    let_it_listen(&mut rig);
}

/// The interrupt of bus-off lasts as long as bus-off does: it must not block everything else.
#[test]
fn a_board_in_bus_off_for_long_is_not_starved_by_its_interrupt() {
    let variant = CanVariant { bus_off_holds_interrupt: true, ..CanVariant::default() };
    let heartbeats = settings(0x40, BitRate::Kbit250).with_heartbeat_ms(100);
    let mut rig = ImageRig::new(BitRate::Kbit250, [board(heartbeats, variant)]);
    rig.collect(Time::from_ms(100));
    assert!(answers(&mut rig));
    rig.network.set_short(Some(Short::Recessive));
    let since = rig.network.now();
    while !rig.did(0, since).any(|event| event.what == What::BusOff) {
        rig.network.run_for(Time::from_us(100));
        assert!(rig.network.now() < since + Time::from_s(1));
    }
    rig.network.set_short(Some(Short::Dominant));
    rig.network.run_for(Time::from_s(6));
    rig.network.set_short(None);
    rig.collect(Time::from_s(2));
    assert!(answers(&mut rig));
    let (cycles, busy) = rig.network.board(0).cycles();
    assert!(busy < cycles / 20, "{busy} of {cycles} cycles");
}

/// The board's line is recessive in every mode except normal mode.
#[test]
fn a_listener_gives_the_line_back_to_the_controller_when_it_takes_part() {
    let mut rig = ImageRig::new(BitRate::Kbit250, [board(listener(), CanVariant::default())]);
    rig.network.run_for(Time::from_ms(10));
    let is_alternate =
        |rig: &ImageRig| rig.network.board(0).chip().gpio().alternate_function(TRANSMIT).is_some();
    assert!(!is_alternate(&rig));
    assert_eq!(rig.network.board(0).output(TRANSMIT).level, Some(true));
    let_it_listen(&mut rig);
    assert!(is_alternate(&rig));
}
