//! Loopback, silent mode and sleep mode (RM0090 32.4.3, 32.5).

use crate::{
    command::{LOOPBACK, SILENT, SLEEP, WAKE_UP, WAKE_UP_AUTOMATICALLY},
    rig::{Driver, MSR, Rig, SLAK, TXM, standard},
};

const RATE: u32 = 500_000;

pub fn loopback_receives_its_own_frames_without_another_node(driver: Driver) {
    let mut rig = Rig::joined(driver, RATE, LOOPBACK);
    rig.network.adapter_mut(rig.adapter).close();
    let frame = standard(0x155, &[1, 2, 3]);
    rig.transmit(frame);
    rig.run_us(500);
    assert_eq!(rig.receive(), Ok(Some(frame)));
    assert!(rig.is_idle());
    assert_eq!(rig.error_counters(), (0, 0));
}

pub fn loopback_shows_its_frames_on_the_bus_and_ignores_those_of_others(driver: Driver) {
    let mut rig = Rig::joined(driver, RATE, LOOPBACK);
    let frame = standard(0x155, &[1, 2, 3]);
    rig.transmit(frame);
    rig.run_us(500);
    assert_eq!(rig.heard(), [frame]);
    assert_eq!(rig.receive(), Ok(Some(frame)));
    rig.add_adapter(RATE);
    rig.send(standard(0x155, &[1]));
    rig.run_us(500);
    assert_eq!(rig.network.adapter_mut(rig.adapter).unsent(), 0, "another adapter acknowledged");
    assert_eq!(rig.receive(), Ok(None));
}

pub fn a_silent_node_receives_and_does_not_acknowledge(driver: Driver) {
    let mut rig = Rig::joined(driver, RATE, SILENT);
    let frame = standard(0x234, &[9]);
    rig.send(frame);
    rig.run_us(2_000);
    let adapter = rig.network.adapter_mut(rig.adapter);
    assert_eq!(adapter.unsent(), 1);
    assert!(adapter.errors() > 5, "{}", adapter.errors());
    rig.add_adapter(RATE);
    rig.run_us(1_000);
    assert_eq!(rig.receive_all(), [frame]);
}

pub fn silent_loopback_is_a_self_test_apart_from_the_bus(driver: Driver) {
    let mut rig = Rig::joined(driver, RATE, LOOPBACK | SILENT);
    rig.add_adapter(RATE);
    let frame = standard(0x155, &[1, 2, 3]);
    rig.transmit(frame);
    rig.run_us(500);
    assert_eq!(rig.receive(), Ok(Some(frame)));
    assert_eq!(rig.heard(), []);
    rig.send(standard(0x234, &[9]));
    rig.run_us(500);
    assert_eq!(rig.receive(), Ok(None));
    assert_eq!(rig.error_counters(), (0, 0));
}

pub fn a_sleeping_node_neither_receives_nor_acknowledges(driver: Driver) {
    let mut rig = Rig::joined(driver, RATE, 0);
    rig.call(SLEEP, &[]);
    assert_eq!(rig.can_register(MSR) & SLAK, SLAK);
    rig.send(standard(0x234, &[9]));
    rig.run_us(2_000);
    assert_eq!(rig.network.adapter_mut(rig.adapter).unsent(), 1);
    assert_eq!(rig.can_register(MSR) & SLAK, SLAK, "it was not set to wake up");
    assert_eq!(rig.receive(), Ok(None));
}

pub fn the_entry_to_sleep_mode_interrupts(driver: Driver) {
    let mut rig = Rig::joined(driver, RATE, 0);
    rig.receive_all();
    let [.., before] = rig.interrupts();
    rig.call(SLEEP, &[]);
    let [.., after] = rig.interrupts();
    assert_eq!(after, before + 1);
}

pub fn sleep_mode_begins_when_the_frame_under_way_has_ended(driver: Driver) {
    let mut rig = Rig::joined(driver, RATE, 0);
    rig.transmit(standard(0x234, &[9; 8]));
    rig.wait("the frame", |rig| rig.can_register(MSR) & TXM != 0);
    rig.begin(SLEEP, &[]);
    rig.run_us(100);
    assert_eq!(rig.can_register(MSR) & (SLAK | TXM), TXM);
    rig.run_us(400);
    assert_eq!(rig.can_register(MSR) & (SLAK | TXM), SLAK);
    assert_eq!(rig.heard().len(), 1);
}

pub fn a_node_that_its_program_wakes_up_joins_the_bus_again(driver: Driver) {
    let mut rig = Rig::joined(driver, RATE, 0);
    rig.call(SLEEP, &[]);
    rig.call(WAKE_UP, &[]);
    assert_eq!(rig.can_register(MSR) & SLAK, 0);
    let frame = standard(0x234, &[9]);
    rig.send(frame);
    rig.run_us(500);
    assert_eq!(rig.receive(), Ok(Some(frame)));
    assert_eq!(rig.transmit(frame), Some((0, None)));
    rig.run_us(500);
    assert_eq!(rig.heard(), [frame]);
}

pub fn a_frame_on_the_bus_wakes_up_a_node_that_is_set_to(driver: Driver) {
    let mut rig = Rig::joined(driver, RATE, 0);
    rig.call(WAKE_UP_AUTOMATICALLY, &[1]);
    rig.call(SLEEP, &[]);
    assert_eq!(rig.can_register(MSR) & SLAK, SLAK);
    // The first one is lost: the node joins after 11 recessive bits. Without another node it is repeated.
    let frame = standard(0x234, &[9]);
    rig.send(frame);
    rig.run_us(2_000);
    assert_eq!(rig.can_register(MSR) & SLAK, 0);
    assert_eq!(rig.receive(), Ok(Some(frame)));
    assert_eq!(rig.network.adapter_mut(rig.adapter).unsent(), 0);
}
