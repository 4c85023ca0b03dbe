//! The restrictions on writes.

use emulator::chip::Problem;

use crate::rig::{BTR, FA1R, HALF_MEGABIT, IER, INRQ, MCR, MEGABIT, Rig, TI0R};

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
