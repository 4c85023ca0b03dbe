//! Receive FIFOs.

use emulator::{
    Time,
    can::{Frame, Id, bxcan::CanVariant},
};

use crate::rig::{IER, RF0R, RFLM, RI0R, Rig, standard};
use emulator::can::bxcan::RX0;

#[test]
fn a_frame_is_readable_from_the_last_but_one_bit_of_eof() {
    let mut rig = Rig::running(0);
    rig.write(IER, 2);
    let frame = Frame::data(Id::Extended(0x1234_5678), &[1, 2, 3, 4, 5]);
    rig.send(frame);
    let asked = rig.now;
    rig.step_until("a message", |rig| rig.read(RF0R) & 3 == 1);
    let took = (rig.now - asked).as_ns();
    let valid = u64::from(frame.wire_bits()) * 1000 - 1_125;
    assert!((valid..valid + 1_600).contains(&took), "{took}");
    assert_eq!(rig.irq(), RX0);
    assert_eq!(rig.read(RI0R), 0x1234_5678 << 3 | 4);
    assert_eq!(rig.read(RI0R + 4), 5);
    assert_eq!(rig.read(RI0R + 8), 0x0403_0201);
    assert_eq!(rig.read(RI0R + 12), 5);
    rig.write(RF0R, 1 << 5);
    assert_eq!(rig.read(RF0R), 0);
    assert_eq!(rig.irq(), 0);
}

#[test]
fn a_fifo_may_show_a_released_frame_for_two_cycles() {
    let variant = CanVariant { late_release: true, ..CanVariant::default() };
    let mut rig = Rig::of_variant(variant, 0);
    (1..=2).for_each(|n| rig.send(standard(0x100, &[n])));
    rig.run_us(200);
    let released = rig.now;
    let shown = |rig: &mut Rig, ps| {
        rig.at(released + Time::from_ps(ps));
        [RF0R, RI0R + 8].map(|register| rig.read(register))
    };
    assert_eq!(shown(&mut rig, 0), [2, 1]);
    rig.write(RF0R, 1 << 5);
    // At 16 MHz.
    assert_eq!(shown(&mut rig, 124_999), [2 | 1 << 5, 1]);
    assert_eq!(shown(&mut rig, 125_000), [1, 2]);
}

#[test]
fn a_data_length_code_above_eight_is_stored_and_sent_as_it_is() {
    let mut rig = Rig::running(0);
    rig.send(standard(0x123, &[7; 8]).with_dlc(12));
    rig.run_us(200);
    assert_eq!(rig.read(RI0R + 4), 12);
    assert_eq!(rig.read(RI0R + 12), 0x0707_0707);
    rig.mailbox(0, standard(0x124, &[9; 8]).with_dlc(15));
    rig.run_us(200);
    assert_eq!(rig.received(), [standard(0x124, &[9; 8]).with_dlc(15)]);
}

#[test]
fn a_full_fifo_replaces_its_third_message_or_if_it_is_locked_keeps_it() {
    for (mcr, kept) in [(0, [1, 2, 5]), (RFLM, [1, 2, 3])] {
        let mut rig = Rig::running(mcr);
        rig.write(IER, 1 << 3);
        (1..=3).for_each(|n| rig.send(standard(0x100, &[n])));
        rig.run_us(300);
        assert_eq!(rig.read(RF0R), 3 | 1 << 3, "FULL");
        assert_eq!(rig.irq(), 0);
        (4..=5).for_each(|n| rig.send(standard(0x100, &[n])));
        rig.run_us(300);
        assert_eq!(rig.read(RF0R), 3 | 1 << 3 | 1 << 4, "FOVR");
        assert_eq!(rig.irq(), RX0);
        rig.write(RF0R, 3 << 3);
        assert_eq!(rig.read(RF0R), 3);
        let data: Vec<u32> = rig.fifo(0).iter().map(|message| message[2]).collect();
        assert_eq!(data, kept);
    }
}

/// Contrary to "cleared by software" in RM0090, 32.9.2 (confidence 0.85).
#[test]
fn full_falls_when_a_frame_is_released() {
    let mut rig = Rig::running(0);
    rig.write(IER, 1 << 2);
    (1..=3).for_each(|n| rig.send(standard(0x100, &[n])));
    rig.run_us(300);
    assert_eq!((rig.read(RF0R), rig.irq() == RX0), (3 | 1 << 3, true));
    rig.write(RF0R, 1 << 5);
    assert_eq!((rig.read(RF0R), rig.irq() == RX0), (2, false));
}
