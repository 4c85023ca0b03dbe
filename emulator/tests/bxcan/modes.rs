//! Initialisation, sleep, silent and loopback mode.

use emulator::{
    Time,
    can::{
        Adapter, BitSegments, Clock, Level,
        bxcan::{Acknowledge, Note, Readings, TransmitLock},
    },
};

use crate::bench::{
    AWUM, BTR, Bench, IER, INAK, INRQ, MCR, MEGABIT, MSR, RF0R, SLAK, SLEEP, TSR, standard,
};

#[test]
fn initialisation_is_entered_while_sleep_is_still_set() {
    let mut bench = Bench::new();
    bench.write(MCR, 0x0001_0000 | SLEEP | INRQ);
    assert_eq!(bench.read(MSR) & 3, INAK);
    bench.write(MCR, SLEEP);
    assert_eq!(bench.read(MSR) & 3, SLAK);
    bench.write(MCR, INRQ);
    assert_eq!(bench.read(MSR) & 3, INAK);
}

#[test]
fn initialisation_is_left_after_eleven_recessive_bits() {
    let mut bench = Bench::new();
    bench.write(MCR, INRQ);
    bench.write(BTR, MEGABIT);
    bench.run_us(100);
    bench.write(MCR, 0);
    let asked = bench.bus.now();
    bench.run(Time::from_ns(10_800));
    assert_eq!(bench.read(MSR) & 3, INAK);
    bench.run(Time::from_ns(100));
    assert_eq!(bench.read(MSR) & 3, 0);
    let left = asked + Time::from_ns(10_875);
    assert_eq!(bench.can.take_notes().pop(), Some((left, Note::InitializationLeft)));
}

#[test]
fn leaving_initialisation_waits_for_an_idle_bus_and_can_be_cancelled() {
    let mut bench = Bench::running(0);
    let mut noise = Adapter::with_timing(
        Clock { hz: 16_000_000, ppm: 0 },
        BitSegments { prescaler: 1, segment_1: 13, segment_2: 2, jump_width: 2 },
    );
    // Alone with the noise at 1 Mbit/s, so that it is never acknowledged and never pauses for 11 bits of 10 kbit/s.
    bench.adapter.close();
    noise.send(standard(0, &[0; 8]));
    let mut run = |bench: &mut Bench, us| {
        let until = bench.bus.now() + Time::from_us(us);
        while bench.bus.advance(until, &mut [&mut bench.can, &mut noise], &mut |_, _, _| {}) < until
        {
        }
    };
    bench.write(MCR, INRQ);
    bench.write(BTR, 0x001C_00C7);
    run(&mut bench, 200);
    bench.write(MCR, 0);
    run(&mut bench, 50_000);
    assert_eq!(bench.read(MSR) & 3, INAK);
    bench.write(MCR, INRQ);
    bench.write(BTR, MEGABIT);
    assert_eq!(bench.read(BTR), MEGABIT);
    bench.write(MCR, 0);
    run(&mut bench, 400);
    assert_eq!(bench.read(MSR) & 3, 0);
}

#[test]
fn initialisation_waits_for_the_own_frame_to_end() {
    let mut bench = Bench::running(0);
    bench.mailbox(0, standard(0x123, &[0; 8]));
    bench.mailbox(1, standard(0x124, &[0; 8]));
    bench.run_us(20);
    assert_eq!(bench.read(MSR) >> 8 & 3, 1, "TXM");
    bench.write(MCR, INRQ);
    assert_eq!(bench.read(MSR) & 3, 0);
    bench.run_us(300);
    assert_eq!(bench.read(MSR) & 3, INAK);
    assert_eq!(bench.received().len(), 1);
    assert_eq!(bench.read(TSR) >> 26 & 7, 0b101, "the second mailbox still waits");
    bench.write(MCR, 0);
    bench.run_us(300);
    assert_eq!(bench.received().len(), 1);
    assert_eq!(bench.read(TSR) >> 26 & 7, 0b111);
}

#[test]
fn silent_mode_receives_without_driving_the_wire() {
    let mut bench = Bench::new();
    bench.open_filter();
    bench.join(0, 1 << 31 | MEGABIT);
    bench.mailbox(0, standard(1, &[]));
    bench.run_us(500);
    assert_eq!(bench.bus.level(), Level::Recessive);
    assert_eq!(bench.read(TSR) >> 26 & 1, 0, "it cannot start");
    bench.adapter.send(standard(0x7E5, &[5]));
    bench.run_us(300);
    assert!(bench.adapter.unsent() == 1 && bench.adapter.errors() > 1, "nobody acknowledges");
}

#[test]
fn loopback_reads_back_its_own_frame() {
    let mut bench = Bench::new();
    bench.open_filter();
    bench.adapter.close();
    bench.join(0, 3 << 30 | MEGABIT);
    bench.mailbox(2, standard(0x7E5, &[5]));
    bench.run_us(100);
    assert_eq!(bench.fifo(0), [[0x7E5 << 21, 1, 5]]);
    assert_eq!(bench.read(TSR), 0x1C03_0000);
}

/// Both happen at the end of EOF (confidence 0.7).
#[test]
fn in_loopback_the_frame_is_received_when_it_is_sent() {
    let mut bench = Bench::new();
    bench.open_filter();
    bench.join(0, 3 << 30 | MEGABIT);
    bench.mailbox(0, standard(0x7E5, &[5]));
    bench.step_until("a message", |bench| bench.read(RF0R) & 3 == 1);
    assert_eq!(bench.read(TSR) & 3, 3);
}

#[test]
fn sleep_ends_on_bus_activity_with_awum() {
    let mut bench = Bench::running(AWUM);
    bench.write(IER, 1 << 16 | 1 << 17);
    bench.write(MCR, AWUM | SLEEP);
    assert_eq!(bench.read(MSR) & 0x1F, SLAK | 1 << 4, "SLAKI");
    assert!(bench.can.irq().sce);
    bench.write(MSR, 1 << 4);
    assert!(!bench.can.irq().sce);
    bench.adapter.send(standard(0x123, &[]));
    bench.run_us(5);
    assert_eq!(bench.read(MSR) & 0x1F, SLAK | 1 << 3, "WKUI");
    assert_eq!(bench.read(MCR) & SLEEP, 0);
    bench.run_us(300);
    assert_eq!(bench.read(MSR) & 3, 0);
}

#[test]
fn sleep_goes_on_without_awum() {
    let mut bench = Bench::running(0);
    bench.write(MCR, SLEEP);
    bench.adapter.send(standard(0x123, &[]));
    bench.run_us(300);
    assert_eq!(bench.read(MSR) & 3, SLAK);
    assert_eq!(bench.read(MSR) >> 3 & 1, 1);
    bench.write(MCR, 0);
    bench.run_us(300);
    assert_eq!(bench.read(MSR) & 3, 0);
}

/// Resets the controller and makes it listen while another node sends a frame.
fn listen_after_reset(bench: &mut Bench) -> Level {
    bench.can.reset();
    bench.join(0, 1 << 31 | MEGABIT);
    bench.adapter.send(standard(0x123, &[]));
    bench.run_us(300);
    bench.adapter.close();
    bench.run_us(300);
    bench.adapter.open();
    bench.bus.level()
}

#[test]
fn the_transmit_pin_may_be_locked_dominant_while_it_listens_until_a_reset() {
    let mut bench = Bench::new();
    let transmit_lock = Some(TransmitLock { every: 2, frame: 1 });
    bench.can.set_readings(Readings { transmit_lock, ..Readings::default() });
    assert_eq!(listen_after_reset(&mut bench), Level::Recessive);
    assert_eq!(listen_after_reset(&mut bench), Level::Dominant);
    bench.write(MCR, INRQ);
    bench.run_us(300);
    assert_eq!(bench.bus.level(), Level::Dominant, "initialisation does not help");
    bench.can.reset();
    bench.run_us(1);
    assert_eq!(bench.bus.level(), Level::Recessive);
}

/// The sequence of PX4's boot loader.
#[test]
fn silent_mode_entered_by_initialisation_does_not_lock_the_transmit_pin() {
    let mut bench = Bench::new();
    let transmit_lock = Some(TransmitLock { every: 1, frame: 1 });
    bench.can.set_readings(Readings { transmit_lock, ..Readings::default() });
    bench.join(0, MEGABIT);
    for _ in 0..3 {
        bench.adapter.close();
        bench.join(0, 1 << 31 | MEGABIT);
        bench.adapter.open();
        bench.adapter.send(standard(0x123, &[]));
        bench.run_us(300);
        bench.adapter.close();
        bench.run_us(100);
        assert_eq!(bench.bus.level(), Level::Recessive);
    }
}

#[test]
fn initialisation_may_be_acknowledged_late() {
    let mut bench = Bench::new();
    let acknowledge = Acknowledge::Late(11);
    bench.can.set_readings(Readings { acknowledge, ..Readings::default() });
    bench.write(MCR, INRQ);
    // After a reset BTR makes eight quanta of one clock period.
    let bits = |bits: u64| Time::from_ns(250) * bits;
    bench.run(bits(11) - Time::from_ns(1));
    bench.write(BTR, MEGABIT);
    assert_eq!((bench.read(MSR) & INAK, bench.read(BTR)), (0, 0x0123_0000));
    bench.run(Time::from_ns(1));
    bench.write(BTR, MEGABIT);
    assert_eq!((bench.read(MSR) & INAK, bench.read(BTR)), (INAK, MEGABIT));
}

#[test]
fn initialisation_may_not_be_acknowledged_until_a_reset() {
    let mut bench = Bench::new();
    let acknowledge = Acknowledge::Lost { every: 2 };
    bench.can.set_readings(Readings { acknowledge, ..Readings::default() });
    let mut acknowledged = Vec::new();
    for _ in 0..4 {
        bench.can.reset();
        bench.write(MCR, INRQ);
        bench.run_us(100);
        let first = bench.read(MSR) & INAK;
        bench.write(MCR, SLEEP);
        bench.write(MCR, INRQ);
        bench.run_us(100);
        acknowledged.push((first, bench.read(MSR) & INAK));
    }
    assert_eq!(acknowledged, [(0, 0), (1, 1), (0, 0), (1, 1)]);
}
