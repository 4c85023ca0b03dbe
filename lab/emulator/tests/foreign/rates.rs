//! Frames in normal mode, at five bit rates (RM0090 32.4.2, 32.7.7).

use emulator::can::{Frame, Id};

use crate::{
    command::{CONFIGURE, ENABLE},
    rig::{Driver, Rig, extended, standard},
};

pub fn frames_go_both_ways_at_each_bit_rate_that_a_running_controller_gets(driver: Driver) {
    let mut rig = Rig::new(driver);
    for bit_rate in [1_000_000, 500_000, 250_000, 125_000, 50_000, 1_000_000] {
        rig.join(bit_rate, 0);
        let from_node = standard(0x123, &[0x55, 0, 0xFF]);
        let from_adapter = standard(0x456, &[7; 8]);
        assert_eq!(rig.transmit(from_node), Some((0, None)), "{bit_rate}");
        rig.send(from_adapter);
        rig.run_us(300_000_000 / u64::from(bit_rate));
        assert_eq!(rig.heard(), [from_node], "{bit_rate}");
        assert_eq!(rig.receive(), Ok(Some(from_adapter)), "{bit_rate}");
        assert_eq!(rig.receive(), Ok(None), "{bit_rate}");
        assert_eq!(rig.error_counters(), (0, 0), "{bit_rate}");
    }
}

pub fn frames_of_each_kind_and_length_go_both_ways(driver: Driver) {
    let mut rig = Rig::joined(driver, 500_000, 0);
    let bytes = [0x80, 1, 0x7F, 0xFE, 0, 0xFF, 0xAA, 0x55];
    let mut frames = Vec::new();
    for length in 0..=8 {
        frames.push(standard(0x7FF - length as u16, &bytes[..length]));
        frames.push(extended(0x1FFF_FFFF - length as u32, &bytes[..length]));
        frames.push(Frame::remote(Id::Standard(length as u16), length as u8));
        frames.push(Frame::remote(Id::Extended(0x40000 + length as u32), length as u8));
    }
    for frame in frames {
        // embassy-stm32 0.6.0 sends these as data frames.
        if driver != Driver::Fdcan || !frame.remote || frame.dlc == 0 {
            assert_ne!(rig.transmit(frame), None, "{frame}");
            rig.run_us(400);
            assert_eq!(rig.heard(), [frame]);
        }
        rig.send(frame);
        rig.run_us(400);
        assert_eq!(rig.receive(), Ok(Some(frame)));
    }
}

/// INRQ and SLEEP clear only after 11 recessive bits.
pub fn a_node_joins_the_bus_only_when_it_is_quiet(driver: Driver) {
    use emulator::network::Short;

    let mut rig = Rig::new(driver);
    rig.call(CONFIGURE, &[500_000, 0]);
    rig.network.set_short(Some(Short::Dominant));
    rig.begin(ENABLE, &[]);
    rig.run_us(2_000);
    assert!(!rig.is_ready());
    rig.network.set_short(None);
    rig.run_us(20);
    assert!(!rig.is_ready(), "ten bits");
    rig.run_us(10);
    assert!(rig.is_ready());
}
