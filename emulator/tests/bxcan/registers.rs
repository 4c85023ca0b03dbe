//! Reset values, and the restrictions on writes.

use emulator::{Time, can::bxcan::Note};

use crate::rig::{
    BTR, CanRig, ESR, FA1R, FFA1R, FM1R, FMR, FS1R, HALF_MEGABIT, IER, INRQ, MCR, MEGABIT, MSR,
    RF0R, RF1R, RFLM, SLAK, TI0R, TSR, standard,
};

#[test]
fn registers_have_their_reset_values() {
    let mut rig = CanRig::new();
    let values = [
        (MCR, 0x0001_0002),
        (MSR, 0x0000_0C02),
        (TSR, 0x1C00_0000),
        (RF0R, 0),
        (RF1R, 0),
        (IER, 0),
        (ESR, 0),
        (BTR, 0x0123_0000),
        (FMR, 0x2A1C_0E01),
        (FM1R, 0),
        (FS1R, 0),
        (FFA1R, 0),
        (FA1R, 0),
    ];
    for (offset, value) in values {
        assert_eq!(rig.read(offset), value, "{offset:#x}");
    }
    for offset in [0x020, 0x17C, 0x1D0, 0x208, 0x210, 0x218, 0x220, 0x23C, 0x320, 0x3FC] {
        assert_eq!(rig.can.read(offset, Time::ZERO), None, "{offset:#x}");
        assert!(!rig.write(offset, 0), "{offset:#x}");
    }
    assert!(rig.can.read(0x31C, Time::ZERO).is_some());
}

#[test]
fn reserved_bits_and_the_sending_of_the_time_are_reported() {
    let mut rig = CanRig::new();
    assert!(rig.write(MCR, INRQ));
    assert!(!rig.write(TI0R + 4, 1 << 8), "TGT");
    assert!(!rig.write(MCR, INRQ | 1 << 20));
    assert!(!rig.write(IER, 1 << 7));
    assert!(!rig.write(BTR, 1 << 10));
    assert!(!rig.write(FA1R, 1 << 28));
}

#[test]
fn bit_timing_is_writable_only_in_initialisation() {
    let mut rig = CanRig::new();
    rig.write(BTR, MEGABIT);
    assert_eq!(rig.read(BTR), 0x0123_0000);
    rig.write(MCR, INRQ);
    rig.write(BTR, MEGABIT);
    assert_eq!(rig.read(BTR), MEGABIT);
    rig.write(MCR, 0);
    rig.write(BTR, HALF_MEGABIT);
    assert_eq!(rig.read(BTR), MEGABIT);
    assert_eq!(rig.can.bit_rate(), 1_000_000);
}

#[test]
fn a_master_reset_puts_it_to_sleep_and_empties_the_fifos() {
    let mut rig = CanRig::running(RFLM);
    rig.adapter.send(standard(0x123, &[]));
    rig.run_us(200);
    assert_eq!(rig.read(RF0R), 1);
    rig.write(MCR, 1 << 15);
    assert_eq!((rig.read(MCR), rig.read(MSR) & 3, rig.read(RF0R)), (0x0001_0002, SLAK, 0));
    assert_eq!((rig.read(BTR), rig.read(FA1R)), (MEGABIT, 1), "nothing else (confidence 0.85)");
}

#[test]
fn writes_are_recorded_with_their_time() {
    let mut rig = CanRig::new();
    rig.can.write(MCR, INRQ, Time::from_us(1));
    rig.can.write(BTR, MEGABIT, Time::from_us(2));
    rig.can.write(BTR, MEGABIT, Time::from_us(3));
    rig.can.write(TI0R, 0x7E4 << 21 | 1, Time::from_us(4));
    let notes = rig.can.take_notes();
    assert_eq!(
        notes,
        [
            (Time::from_us(1), Note::InitializationEntered),
            (Time::from_us(2), Note::BitTiming(MEGABIT)),
            (Time::from_us(4), Note::Requested { mailbox: 0, frame: standard(0x7E4, &[]) }),
        ]
    );
}
