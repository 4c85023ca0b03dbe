//! Reset values, and the restrictions on writes.

use emulator::{Time, can::Note, chip::Problem};

use crate::rig::{
    BTR, ESR, FA1R, FFA1R, FM1R, FMR, FS1R, HALF_MEGABIT, IER, INRQ, MCR, MEGABIT, MSR, RF0R, RF1R,
    RFLM, Rig, SLAK, TI0R, TSR, standard,
};

#[test]
fn registers_have_their_reset_values() {
    let mut rig = Rig::after_reset();
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
    for (register, value) in values {
        assert_eq!(rig.read(register), value, "{register:#x}");
    }
    rig.read(MCR + 0x31C);
    assert_eq!(rig.problems(), []);
    for offset in [0x020, 0x17C, 0x1D0, 0x208, 0x210, 0x218, 0x220, 0x23C, 0x320, 0x3FC] {
        assert_eq!(rig.read(MCR + offset), 0, "{offset:#x}");
        rig.write(MCR + offset, 0);
    }
    assert_eq!(rig.problems(), [Problem::Unmodelled; 20]);
}

#[test]
fn reserved_bits_and_the_sending_of_the_time_are_reported() {
    let mut rig = Rig::after_reset();
    rig.write(MCR, INRQ);
    // The first one is TGT.
    let writes = [(TI0R + 4, 8), (MCR, 20), (IER, 7), (BTR, 10), (FA1R, 28)];
    for (register, bit) in writes {
        rig.write(register, INRQ | 1 << bit);
    }
    let found: Vec<_> = rig.findings().iter().map(|found| (found.address, found.problem)).collect();
    assert_eq!(found, writes.map(|(register, _)| (register, Problem::Unmodelled)));
}

#[test]
fn bit_timing_is_writable_only_in_initialisation() {
    let mut rig = Rig::after_reset();
    rig.write(BTR, MEGABIT);
    assert_eq!(rig.read(BTR), 0x0123_0000);
    rig.write_all(&[(MCR, INRQ), (BTR, MEGABIT)]);
    assert_eq!(rig.read(BTR), MEGABIT);
    rig.write_all(&[(MCR, 0), (BTR, HALF_MEGABIT)]);
    assert_eq!(rig.read(BTR), MEGABIT);
    assert_eq!(rig.can_mut(1).bit_rate(), 1_000_000);
}

#[test]
fn a_master_reset_puts_it_to_sleep_and_empties_the_fifos() {
    let mut rig = Rig::running(RFLM);
    rig.send(standard(0x123, &[]));
    rig.run_us(200);
    assert_eq!(rig.read(RF0R), 1);
    rig.write(MCR, 1 << 15);
    assert_eq!((rig.read(MCR), rig.read(MSR) & 3, rig.read(RF0R)), (0x0001_0002, SLAK, 0));
    assert_eq!((rig.read(BTR), rig.read(FA1R)), (MEGABIT, 1), "nothing else (confidence 0.85)");
}

#[test]
fn writes_are_recorded_with_their_time() {
    let mut rig = Rig::after_reset();
    rig.at_us(11).write(MCR, INRQ);
    rig.at_us(12).write(BTR, MEGABIT);
    rig.at_us(13).write(BTR, MEGABIT);
    rig.at_us(14).write(TI0R, 0x7E4 << 21 | 1);
    let notes = rig.can_mut(1).take_notes();
    assert_eq!(
        notes,
        [
            (Time::from_us(11), Note::InitializationEntered),
            (Time::from_us(12), Note::BitTiming(MEGABIT)),
            (Time::from_us(14), Note::Requested { mailbox: 0, frame: standard(0x7E4, &[]) }),
        ]
    );
}
