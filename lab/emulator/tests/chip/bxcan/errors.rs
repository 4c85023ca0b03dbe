//! Error flags, error codes, bus-off, and a bus at another rate.

use emulator::{Time, can::bxcan::CanVariant};

use crate::rig::{ESR, IER, INAK, INRQ, MCR, MCR_RESET, MSR, Rig, TSR, standard};
use emulator::can::bxcan::SCE;

#[test]
fn alone_the_warning_and_passive_flags_rise_at_96_and_128_with_interrupts() {
    let mut rig = Rig::running(0);
    rig.adapter().close();
    rig.write(IER, 1 << 15 | 1 << 8 | 1 << 9);
    rig.mailbox(0, standard(0x123, &[]));
    rig.step_until("EWGF", |rig| rig.read(ESR) & 1 == 1);
    assert_eq!(rig.read(ESR), 96 << 16 | 3 << 4 | 0b001);
    assert_eq!(rig.irq(), SCE);
    assert_eq!(rig.read(MSR) >> 2 & 1, 1);
    rig.write(MSR, 1 << 2);
    assert_eq!(rig.irq(), 0);
    rig.run_us(100);
    assert_eq!(rig.irq(), 0);
    rig.step_until("EPVF", |rig| rig.read(ESR) & 2 == 2);
    assert_eq!(rig.read(ESR), 128 << 16 | 3 << 4 | 0b011);
    assert_eq!(rig.irq(), SCE);
    rig.run(Time::from_ms(20));
    assert_eq!(rig.read(ESR), 128 << 16 | 3 << 4 | 0b011, "the counter stands");
}

#[test]
fn error_codes_interrupt_with_lecie_and_a_good_frame_clears_the_code() {
    let mut rig = Rig::running(0);
    rig.write(ESR, 7 << 4);
    assert_eq!(rig.read(ESR), 7 << 4);
    rig.write(IER, 1 << 15 | 1 << 11);
    rig.adapter().close();
    rig.mailbox(0, standard(0x123, &[]));
    rig.run_us(60);
    assert_eq!(rig.read(ESR) >> 4 & 7, 3);
    assert_eq!(rig.irq(), SCE);
    rig.adapter().open();
    rig.run_us(1000);
    assert_eq!(rig.read(ESR) >> 4 & 7, 0);
}

/// Raises the transmit error counter above 255 by noise at half the rate.
fn bus_off(variant: CanVariant, mcr: u32) -> Rig {
    let mut rig = Rig::of_variant(variant, mcr);
    rig.adapter().set_bit_rate(500_000);
    rig.mailbox(0, standard(0x7FF, &[0xFF; 8]));
    let limit = Time::from_s(1);
    while rig.read(ESR) & 4 == 0 {
        rig.send(standard(0, &[0; 8]));
        rig.run_us(100);
        assert!(rig.now < limit, "ESR {:#010x}", rig.read(ESR));
    }
    rig.adapter().close();
    rig
}

#[test]
fn bus_off_lasts_until_the_program_passes_through_initialisation() {
    let mut rig = bus_off(CanVariant::default(), 0);
    assert_eq!(rig.read(ESR) & 7, 7);
    rig.run(Time::from_ms(10));
    assert_eq!(rig.read(ESR) & 4, 4);
    rig.write(MCR, INRQ);
    assert_eq!(rig.read(MSR) & 3, INAK);
    rig.run(Time::from_ms(10));
    rig.write(MCR, 0);
    rig.run_us(11);
    assert_eq!(rig.read(MSR) & 3, 0, "INAK falls after the first 11 bits");
    assert_eq!(rig.read(ESR) & 4, 4);
    rig.run_us(128 * 11 - 12);
    assert_eq!(rig.read(ESR) & 4, 4);
    rig.run_us(2);
    assert_eq!(rig.read(ESR) & 0xFFFF_0007, 0);
}

/// As captured from a chip (confidence 0.8); the manual does not state it.
#[test]
fn the_transmit_error_counter_reads_248_in_bus_off() {
    let tec = |variant| bus_off(variant, 0).read(ESR) >> 16 & 0xFF;
    assert_eq!(tec(CanVariant::default()), 0xF8);
    assert!(tec(CanVariant { bus_off_tec_overflows: true, ..CanVariant::default() }) < 8);
}

/// Only a reset by RCC clears the counters (confidence 0.85).
#[test]
fn neither_a_master_reset_nor_initialisation_leaves_error_passive() {
    let mut rig = Rig::running(0);
    rig.adapter().close();
    rig.mailbox(0, standard(0x123, &[]));
    rig.step_until("EPVF", |rig| rig.read(ESR) & 2 == 2);
    rig.write(TSR, 1 << 7);
    rig.run(Time::from_ms(1));
    for mcr in [MCR_RESET, INRQ] {
        rig.write(MCR, mcr);
        rig.run_us(300);
        rig.write(MCR, 0);
        rig.run_us(300);
        assert_eq!(rig.read(ESR) & 7, 3);
    }
    rig.reset_by_rcc(1 << 25);
    assert_eq!(rig.read(ESR), 0);
}

#[test]
fn errors_may_interrupt_again_and_again_while_passive() {
    let interrupts = |variant| {
        let mut rig = Rig::of_variant(variant, 0);
        rig.adapter().close();
        rig.write(IER, 1 << 15 | 1 << 9);
        rig.mailbox(0, standard(0x123, &[]));
        rig.step_until("EPVF", |rig| rig.irq() == SCE);
        rig.write(MSR, 1 << 2);
        assert_eq!(rig.irq(), 0);
        rig.run_us(200);
        rig.irq() == SCE
    };
    assert!(!interrupts(CanVariant::default()));
    assert!(interrupts(CanVariant { passive_errors_interrupt: true, ..CanVariant::default() }));
}

#[test]
fn bus_off_may_hold_its_interrupt_until_it_is_over() {
    let holds = |variant| {
        let mut rig = bus_off(variant, 0);
        rig.write_all(&[(IER, 1 << 15 | 1 << 10), (MSR, 1 << 2)]);
        rig.irq() == SCE
    };
    assert!(!holds(CanVariant::default()));
    assert!(holds(CanVariant { bus_off_holds_interrupt: true, ..CanVariant::default() }));
}
