//! Receive FIFOs.

use emulator::{
    Time,
    can::{Frame, Id, bxcan::CanVariant},
};

use crate::rig::{CanRig, IER, RF0R, RFLM, RI0R, standard};

#[test]
fn a_frame_is_readable_from_the_last_but_one_bit_of_eof() {
    let mut rig = CanRig::running(0);
    rig.write(IER, 2);
    let frame = Frame::data(Id::Extended(0x1234_5678), &[1, 2, 3, 4, 5]);
    rig.adapter.send(frame);
    let asked = rig.bus.now();
    rig.step_until("a message", |rig| rig.read(RF0R) & 3 == 1);
    let took = (rig.bus.now() - asked).as_ns();
    let valid = u64::from(frame.wire_bits()) * 1000 - 1_125;
    assert!((valid..valid + 1_600).contains(&took), "{took}");
    assert!(rig.can.irq().rx0);
    assert_eq!(rig.read(RI0R), 0x1234_5678 << 3 | 4);
    assert_eq!(rig.read(RI0R + 4), 5);
    assert_eq!(rig.read(RI0R + 8), 0x0403_0201);
    assert_eq!(rig.read(RI0R + 12), 5);
    rig.write(RF0R, 1 << 5);
    assert_eq!(rig.read(RF0R), 0);
    assert!(!rig.can.irq().rx0);
}

#[test]
fn a_fifo_may_show_a_released_frame_for_two_cycles() {
    let variant = CanVariant { late_release: true, ..CanVariant::default() };
    let mut rig = CanRig::of_variant(variant, 0);
    (1..=2).for_each(|n| rig.adapter.send(standard(0x100, &[n])));
    rig.run_us(200);
    let shown = |rig: &CanRig, ps| {
        let read = |offset| rig.can.read(offset, rig.bus.now() + Time::from_ps(ps));
        (read(RF0R), read(RI0R + 8))
    };
    assert_eq!(shown(&rig, 0), (Some(2), Some(1)));
    rig.write(RF0R, 1 << 5);
    // At 32 MHz.
    assert_eq!(shown(&rig, 62_499), (Some(2 | 1 << 5), Some(1)));
    assert_eq!(shown(&rig, 62_500), (Some(1), Some(2)));
}

#[test]
fn a_data_length_code_above_eight_is_stored_and_sent_as_it_is() {
    let mut rig = CanRig::running(0);
    rig.adapter.send(standard(0x123, &[7; 8]).with_dlc(12));
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
        let mut rig = CanRig::running(mcr);
        rig.write(IER, 1 << 3);
        (1..=3).for_each(|n| rig.adapter.send(standard(0x100, &[n])));
        rig.run_us(300);
        assert_eq!(rig.read(RF0R), 3 | 1 << 3, "FULL");
        assert!(!rig.can.irq().rx0);
        (4..=5).for_each(|n| rig.adapter.send(standard(0x100, &[n])));
        rig.run_us(300);
        assert_eq!(rig.read(RF0R), 3 | 1 << 3 | 1 << 4, "FOVR");
        assert!(rig.can.irq().rx0);
        rig.write(RF0R, 3 << 3);
        assert_eq!(rig.read(RF0R), 3);
        let data: Vec<u32> = rig.fifo(0).iter().map(|message| message[2]).collect();
        assert_eq!(data, kept);
    }
}

/// Contrary to "cleared by software" in RM0090, 32.9.2 (confidence 0.85).
#[test]
fn full_falls_when_a_frame_is_released() {
    let mut rig = CanRig::running(0);
    rig.write(IER, 1 << 2);
    (1..=3).for_each(|n| rig.adapter.send(standard(0x100, &[n])));
    rig.run_us(300);
    assert_eq!((rig.read(RF0R), rig.can.irq().rx0), (3 | 1 << 3, true));
    rig.write(RF0R, 1 << 5);
    assert_eq!((rig.read(RF0R), rig.can.irq().rx0), (2, false));
}

#[test]
fn a_frame_has_the_time_of_its_sof_in_time_triggered_mode() {
    const TTCM: u32 = 1 << 7;
    for (mcr, apart) in [(TTCM, 300), (0, 0)] {
        let mut rig = CanRig::running(mcr);
        rig.adapter.send(standard(0x100, &[1]));
        rig.run_us(300);
        rig.adapter.send(standard(0x100, &[2]));
        rig.run_us(300);
        let stamps: Vec<u32> = rig.fifo(0).iter().map(|message| message[1] >> 16).collect();
        assert_eq!(stamps[1] - stamps[0], apart, "{stamps:?}");
    }
}
