//! Error flags, error codes, bus-off, and a bus at another rate.

use emulator::{
    Time,
    can::{Adapter, Event, Station, bxcan::Readings},
};

use crate::bench::{
    ABOM, Bench, ESR, HALF_MEGABIT, IER, INAK, INRQ, MCR, MCR_RESET, MSR, RF0R, TSR, standard,
};

#[test]
fn alone_the_warning_and_passive_flags_rise_at_96_and_128_with_interrupts() {
    let mut bench = Bench::running(0);
    bench.adapter.close();
    bench.write(IER, 1 << 15 | 1 << 8 | 1 << 9);
    bench.mailbox(0, standard(0x123, &[]));
    bench.step_until("EWGF", |bench| bench.read(ESR) & 1 == 1);
    assert_eq!(bench.read(ESR), 96 << 16 | 3 << 4 | 0b001);
    assert!(bench.can.irq().sce);
    assert_eq!(bench.read(MSR) >> 2 & 1, 1);
    bench.write(MSR, 1 << 2);
    assert!(!bench.can.irq().sce);
    bench.run_us(100);
    assert!(!bench.can.irq().sce);
    bench.step_until("EPVF", |bench| bench.read(ESR) & 2 == 2);
    assert_eq!(bench.read(ESR), 128 << 16 | 3 << 4 | 0b011);
    assert!(bench.can.irq().sce);
    bench.run(Time::from_ms(20));
    assert_eq!(bench.read(ESR), 128 << 16 | 3 << 4 | 0b011, "the counter stands");
}

#[test]
fn error_codes_interrupt_with_lecie_and_a_good_frame_clears_the_code() {
    let mut bench = Bench::running(0);
    bench.write(ESR, 7 << 4);
    assert_eq!(bench.read(ESR), 7 << 4);
    bench.write(IER, 1 << 15 | 1 << 11);
    bench.adapter.close();
    bench.mailbox(0, standard(0x123, &[]));
    bench.run_us(60);
    assert_eq!(bench.read(ESR) >> 4 & 7, 3);
    assert!(bench.can.irq().sce);
    bench.adapter.open();
    bench.run_us(1000);
    assert_eq!(bench.read(ESR) >> 4 & 7, 0);
}

/// Raises the transmit error counter above 255 by noise at half the rate.
fn bus_off(readings: Readings, mcr: u32) -> Bench {
    let mut bench = Bench::reading(readings, mcr);
    bench.adapter.set_bit_rate(500_000);
    bench.mailbox(0, standard(0x7FF, &[0xFF; 8]));
    let limit = Time::from_s(1);
    while bench.read(ESR) & 4 == 0 {
        bench.adapter.send(standard(0, &[0; 8]));
        bench.run_us(100);
        assert!(bench.bus.now() < limit, "ESR {:#010x}", bench.read(ESR));
    }
    bench.adapter.close();
    bench
}

#[test]
fn bus_off_lasts_until_the_program_passes_through_initialisation() {
    let mut bench = bus_off(Readings::default(), 0);
    assert_eq!(bench.read(ESR) & 7, 7);
    bench.run(Time::from_ms(10));
    assert_eq!(bench.read(ESR) & 4, 4);
    bench.write(MCR, INRQ);
    assert_eq!(bench.read(MSR) & 3, INAK);
    bench.run(Time::from_ms(10));
    bench.write(MCR, 0);
    bench.run_us(11);
    assert_eq!(bench.read(MSR) & 3, 0, "INAK falls after the first 11 bits");
    assert_eq!(bench.read(ESR) & 4, 4);
    bench.run_us(128 * 11 - 12);
    assert_eq!(bench.read(ESR) & 4, 4);
    bench.run_us(2);
    assert_eq!(bench.read(ESR) & 0xFFFF_0007, 0);
}

#[test]
fn bus_off_ends_by_itself_with_abom_and_the_mailbox_is_sent_at_last() {
    let mut bench = bus_off(Readings::default(), ABOM);
    bench.adapter.set_bit_rate(1_000_000);
    bench.adapter.open();
    bench.run_us(1_700);
    assert_eq!(bench.read(ESR) & 7, 0);
    assert_eq!(bench.received(), [standard(0x7FF, &[0xFF; 8])]);
}

#[test]
fn a_node_at_another_rate_counts_errors_and_destroys_frames() {
    let mut bench = Bench::new();
    bench.open_filter();
    bench.join(0, HALF_MEGABIT);
    let mut peer = Adapter::new(1_000_000);
    bench.adapter.send(standard(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]));
    let until = bench.bus.now() + Time::from_ms(5);
    let mut errors = 0;
    while bench.bus.now() < until {
        let stations: &mut [&mut dyn Station] =
            &mut [&mut bench.can, &mut bench.adapter, &mut peer];
        bench.bus.advance(until, stations, &mut |station, _, event| {
            errors += u32::from(station == 0 && matches!(event, Event::Error { .. }));
        });
    }
    assert!(errors > 0);
    assert_eq!(bench.read(RF0R), 0);
    assert!(bench.read(ESR) >> 24 > 0 && bench.adapter.errors() > 0);
}

/// As captured from a chip (confidence 0.8); the manual does not state it.
#[test]
fn the_transmit_error_counter_reads_248_in_bus_off() {
    let tec = |readings| bus_off(readings, 0).read(ESR) >> 16 & 0xFF;
    assert_eq!(tec(Readings::default()), 0xF8);
    assert!(tec(Readings { bus_off_tec_overflows: true, ..Readings::default() }) < 8);
}

/// Only a reset by RCC clears the counters (confidence 0.85).
#[test]
fn neither_a_master_reset_nor_initialisation_leaves_error_passive() {
    let mut bench = Bench::running(0);
    bench.adapter.close();
    bench.mailbox(0, standard(0x123, &[]));
    bench.step_until("EPVF", |bench| bench.read(ESR) & 2 == 2);
    bench.write(TSR, 1 << 7);
    bench.run(Time::from_ms(1));
    for mcr in [MCR_RESET, INRQ] {
        bench.write(MCR, mcr);
        bench.run_us(300);
        bench.write(MCR, 0);
        bench.run_us(300);
        assert_eq!(bench.read(ESR) & 7, 3);
    }
    bench.can.reset();
    assert_eq!(bench.read(ESR), 0);
}

#[test]
fn errors_may_interrupt_again_and_again_while_passive() {
    let interrupts = |readings| {
        let mut bench = Bench::reading(readings, 0);
        bench.adapter.close();
        bench.write(IER, 1 << 15 | 1 << 9);
        bench.mailbox(0, standard(0x123, &[]));
        bench.step_until("EPVF", |bench| bench.can.irq().sce);
        bench.write(MSR, 1 << 2);
        assert!(!bench.can.irq().sce);
        bench.run_us(200);
        bench.can.irq().sce
    };
    assert!(!interrupts(Readings::default()));
    assert!(interrupts(Readings { passive_errors_interrupt: true, ..Readings::default() }));
}

#[test]
fn bus_off_may_hold_its_interrupt_until_it_is_over() {
    let holds = |readings| {
        let mut bench = bus_off(readings, 0);
        bench.write(IER, 1 << 15 | 1 << 10);
        bench.write(MSR, 1 << 2);
        bench.can.irq().sce
    };
    assert!(!holds(Readings::default()));
    assert!(holds(Readings { bus_off_holds_interrupt: true, ..Readings::default() }));
}
