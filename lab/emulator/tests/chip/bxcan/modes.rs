//! Initialisation, sleep, silent and loopback mode.

use emulator::{
    Time,
    can::{
        Level, Note,
        bxcan::{Acknowledge, CanVariant, TransmitLock},
    },
};

use crate::rig::{AWUM, BTR, IER, INAK, INRQ, MCR, MEGABIT, MSR, Rig, SLAK, SLEEP, TSR, standard};
use emulator::can::bxcan::SCE;

#[test]
fn initialisation_is_entered_while_sleep_is_still_set() {
    let mut rig = Rig::after_reset();
    rig.write(MCR, 0x0001_0000 | SLEEP | INRQ);
    assert_eq!(rig.read(MSR) & 3, INAK);
    rig.write(MCR, SLEEP);
    assert_eq!(rig.read(MSR) & 3, SLAK);
    rig.write(MCR, INRQ);
    assert_eq!(rig.read(MSR) & 3, INAK);
}

#[test]
fn initialisation_is_left_after_eleven_recessive_bits() {
    let mut rig = Rig::after_reset();
    rig.write_all(&[(MCR, INRQ), (BTR, MEGABIT)]);
    rig.run_us(100);
    rig.write(MCR, 0);
    let asked = rig.now;
    rig.run(Time::from_ns(10_800));
    assert_eq!(rig.read(MSR) & 3, INAK);
    rig.run(Time::from_ns(100));
    assert_eq!(rig.read(MSR) & 3, 0);
    let left = asked + Time::from_ns(10_875);
    assert_eq!(rig.can_mut(1).take_notes().pop(), Some((left, Note::InitializationLeft)));
}

#[test]
fn leaving_initialisation_waits_for_an_idle_bus_and_can_be_cancelled() {
    let mut rig = Rig::running(0);
    // Never acknowledged, the adapter never pauses for 11 bits of 10 kbit/s.
    rig.write_all(&[(MCR, INRQ), (BTR, 0x001C_0063)]);
    rig.send(standard(0, &[0; 8]));
    rig.run_us(200);
    rig.write(MCR, 0);
    rig.run_us(50_000);
    assert_eq!(rig.read(MSR) & 3, INAK);
    rig.write_all(&[(MCR, INRQ), (BTR, MEGABIT)]);
    assert_eq!(rig.read(BTR), MEGABIT);
    rig.write(MCR, 0);
    rig.run_us(400);
    assert_eq!(rig.read(MSR) & 3, 0);
}

#[test]
fn initialisation_waits_for_the_own_frame_to_end() {
    let mut rig = Rig::running(0);
    rig.mailbox(0, standard(0x123, &[0; 8]));
    rig.mailbox(1, standard(0x124, &[0; 8]));
    rig.run_us(20);
    assert_eq!(rig.read(MSR) >> 8 & 3, 1, "TXM");
    rig.write(MCR, INRQ);
    assert_eq!(rig.read(MSR) & 3, 0);
    rig.run_us(300);
    assert_eq!(rig.read(MSR) & 3, INAK);
    assert_eq!(rig.received().len(), 1);
    assert_eq!(rig.read(TSR) >> 26 & 7, 0b101, "the second mailbox still waits");
    rig.write(MCR, 0);
    rig.run_us(300);
    assert_eq!(rig.received().len(), 1);
    assert_eq!(rig.read(TSR) >> 26 & 7, 0b111);
}

#[test]
fn sleep_ends_on_bus_activity_with_awum() {
    let mut rig = Rig::running(AWUM);
    rig.write_all(&[(IER, 1 << 16 | 1 << 17), (MCR, AWUM | SLEEP)]);
    assert_eq!(rig.read(MSR) & 0x1F, SLAK | 1 << 4, "SLAKI");
    assert_eq!(rig.irq(), SCE);
    rig.write(MSR, 1 << 4);
    assert_eq!(rig.irq(), 0);
    rig.send(standard(0x123, &[]));
    rig.run_us(5);
    assert_eq!(rig.read(MSR) & 0x1F, SLAK | 1 << 3, "WKUI");
    assert_eq!(rig.read(MCR) & SLEEP, 0);
    rig.run_us(300);
    assert_eq!(rig.read(MSR) & 3, 0);
}

/// Resets the controller and makes it listen while another node sends a frame.
fn listen_after_reset(rig: &mut Rig) -> Level {
    rig.reset_by_rcc(1 << 25);
    rig.join(0, 1 << 31 | MEGABIT);
    rig.send(standard(0x123, &[]));
    rig.run_us(300);
    rig.adapter().close();
    rig.run_us(300);
    rig.adapter().open();
    rig.buses[0].0.level()
}

#[test]
fn the_transmit_pin_may_be_locked_dominant_while_it_listens_until_a_reset() {
    let mut rig = Rig::after_reset();
    let transmit_lock = Some(TransmitLock { every: 2, frame: 1 });
    rig.can_mut(1).set_variant(CanVariant { transmit_lock, ..CanVariant::default() });
    assert_eq!(listen_after_reset(&mut rig), Level::Recessive);
    assert_eq!(listen_after_reset(&mut rig), Level::Dominant);
    rig.write(MCR, INRQ);
    rig.run_us(300);
    assert_eq!(rig.buses[0].0.level(), Level::Dominant, "initialisation does not help");
    rig.reset_by_rcc(1 << 25);
    rig.run_us(1);
    assert_eq!(rig.buses[0].0.level(), Level::Recessive);
}

/// The sequence of PX4's boot loader.
#[test]
fn silent_mode_entered_by_initialisation_does_not_lock_the_transmit_pin() {
    let mut rig = Rig::after_reset();
    let transmit_lock = Some(TransmitLock { every: 1, frame: 1 });
    rig.can_mut(1).set_variant(CanVariant { transmit_lock, ..CanVariant::default() });
    rig.join(0, MEGABIT);
    for _ in 0..3 {
        rig.adapter().close();
        rig.join(0, 1 << 31 | MEGABIT);
        rig.adapter().open();
        rig.send(standard(0x123, &[]));
        rig.run_us(300);
        rig.adapter().close();
        rig.run_us(100);
        assert_eq!(rig.buses[0].0.level(), Level::Recessive);
    }
}

#[test]
fn initialisation_may_be_acknowledged_late() {
    let mut rig = Rig::after_reset();
    let acknowledge = Acknowledge::Late(11);
    rig.can_mut(1).set_variant(CanVariant { acknowledge, ..CanVariant::default() });
    rig.write(MCR, INRQ);
    // After a reset BTR makes eight quanta of one clock period.
    let bits = |bits: u64| Time::from_ns(500) * bits;
    rig.run(bits(11) - Time::from_ns(1));
    rig.write(BTR, MEGABIT);
    assert_eq!((rig.read(MSR) & INAK, rig.read(BTR)), (0, 0x0123_0000));
    rig.run(Time::from_ns(1));
    rig.write(BTR, MEGABIT);
    assert_eq!((rig.read(MSR) & INAK, rig.read(BTR)), (INAK, MEGABIT));
}

#[test]
fn initialisation_may_not_be_acknowledged_until_a_reset() {
    let mut rig = Rig::after_reset();
    let acknowledge = Acknowledge::Lost { every: 2 };
    rig.can_mut(1).set_variant(CanVariant { acknowledge, ..CanVariant::default() });
    let mut acknowledged = Vec::new();
    for _ in 0..4 {
        rig.reset_by_rcc(1 << 25);
        rig.write(MCR, INRQ);
        rig.run_us(100);
        let first = rig.read(MSR) & INAK;
        rig.write_all(&[(MCR, SLEEP), (MCR, INRQ)]);
        rig.run_us(100);
        acknowledged.push((first, rig.read(MSR) & INAK));
    }
    assert_eq!(acknowledged, [(0, 0), (1, 1), (0, 0), (1, 1)]);
}
