//! Errors, their counters, and bus-off (RM0090 32.7.6).

use emulator::{
    Time,
    network::{Short, Source},
};

use crate::rig::{BUS_OFF, Driver, PASSIVE, Rig, WARNING, standard};

const RATE: u32 = 500_000;

pub fn a_node_alone_becomes_error_passive_and_repeats_until_somebody_acknowledges(driver: Driver) {
    let mut rig = Rig::joined(driver, RATE, 0);
    rig.network.adapter_mut(rig.adapter).close();
    rig.transmit(standard(0x123, &[1]));
    rig.run_us(20_000);
    assert_eq!(rig.error_counters(), (128, 0));
    assert_eq!(rig.error_state(), WARNING | PASSIVE);
    rig.network.adapter_mut(rig.adapter).open();
    rig.run_us(2_000);
    assert_eq!(rig.heard(), [standard(0x123, &[1])]);
    assert_eq!(rig.error_counters(), (127, 0), "one less for the good frame");
    assert_eq!(rig.error_state(), WARNING);
}

/// A board that has gone bus-off on a bus whose wires touch.
fn in_bus_off(driver: Driver) -> Rig {
    let mut rig = Rig::joined(driver, RATE, 0);
    rig.network.set_short(Some(Short::Recessive));
    rig.transmit(standard(0x123, &[1]));
    rig.wait("bus-off", |rig| rig.error_state() & BUS_OFF != 0);
    assert!(!rig.is_transmitting());
    rig
}

/// Both drivers set ABOM.
pub fn bus_off_ends_after_128_times_11_recessive_bits_and_spares_the_mailbox(driver: Driver) {
    let mut rig = in_bus_off(driver);
    rig.network.set_short(None);
    let begin = rig.network.now();
    rig.wait("the recovery", |rig| rig.error_state() & BUS_OFF == 0);
    let bits = (rig.network.now() - begin).as_us() / 2;
    assert!((1_405..1_425).contains(&bits), "{bits} bits");
    rig.run_us(500);
    assert_eq!(rig.heard(), [standard(0x123, &[1])]);
    assert_eq!(rig.error_counters(), (0, 0));
}

pub fn bus_off_lasts_as_long_as_the_bus_is_dominant(driver: Driver) {
    let mut rig = in_bus_off(driver);
    rig.network.set_short(Some(Short::Dominant));
    rig.run_us(10_000);
    assert_eq!(rig.error_state() & BUS_OFF, BUS_OFF);
    rig.network.set_short(None);
    rig.run_us(4_000);
    assert_eq!(rig.error_state() & BUS_OFF, 0);
}

pub fn a_frame_with_an_error_is_repeated_and_received_once(driver: Driver) {
    let mut rig = Rig::joined(driver, RATE, 0);
    let board = Source::Board(rig.board);
    rig.network.flip_bit(board, rig.network.now() + Time::from_us(60));
    rig.send(standard(0x123, &[1, 2, 3, 4]));
    rig.run_us(600);
    assert_eq!(rig.network.adapter_mut(rig.adapter).errors(), 1);
    let received = rig.receive_all();
    assert_eq!(received, [standard(0x123, &[1, 2, 3, 4])]);
    // Up by 1 for the error, down by 1 for the good frame.
    assert_eq!(rig.error_counters(), (0, 0));
}

pub fn the_receive_error_counter_rises_with_each_bad_frame(driver: Driver) {
    let mut rig = Rig::joined(driver, RATE, 0);
    rig.network.adapter_mut(rig.adapter).set_bit_rate(250_000);
    rig.send(standard(0x123, &[0xAA; 8]));
    rig.run_us(10_000);
    let (transmit, receive) = rig.error_counters();
    assert_eq!(transmit, 0);
    assert!(receive > 20, "{receive}");
    // Good frames lower it again.
    rig.network.adapter_mut(rig.adapter).set_bit_rate(RATE);
    for _ in 0..10 {
        rig.send(standard(0x123, &[1]));
    }
    rig.run_us(3_000);
    let (_, lower) = rig.error_counters();
    assert!(lower < receive, "{lower}, {receive}");
}

pub fn a_transmission_with_an_error_is_repeated_at_once(driver: Driver) {
    let mut rig = Rig::joined(driver, RATE, 0);
    let frame = standard(0x123, &[1, 2, 3, 4]);
    assert_eq!(rig.transmit(frame), Some((0, None)));
    rig.wait("the frame", |rig| rig.is_transmitting());
    let board = Source::Board(rig.board);
    rig.network.flip_bit(board, rig.network.now() + Time::from_us(60));
    rig.run_us(600);
    assert_eq!(rig.heard(), [frame]);
    // Up by 8 for the error, down by 1 for the good frame.
    assert_eq!(rig.error_counters(), (7, 0));
    assert!(!matches!(rig.receive(), Ok(Some(_))));
}
