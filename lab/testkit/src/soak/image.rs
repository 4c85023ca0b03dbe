//! The share of the long life that the release image lives on emulated boards.

use canopen_node::BitRate;
use emulator::Time;

use super::{BOARDS, HEARTBEAT_MS, RATES};
use crate::{
    image::Firmware,
    image_rig::{ImageRig, board_with, settings},
    random::Random,
};

/// The switch delay in milliseconds.
const DELAY_MS: u64 = 10;
/// The quiet times of a session, and their length in seconds.
const QUIET_TIMES: u64 = 4;
const QUIET_S: u64 = 5;

/// A session with new boards: power cuts and switches of the bit rate, each followed by a quiet time. Returns the
/// virtual time. Panics if a heartbeat is missing in a quiet time, or anything else is sent.
pub fn session(random: &mut Random) -> Time {
    let mut rate = random.pick(&RATES);
    let board = |number: usize| {
        let settings = settings(number as u8 + 1, rate);
        board_with(Firmware::Default, number as u8, settings.with_heartbeat_ms(HEARTBEAT_MS))
    };
    let mut rig = ImageRig::new(rate, (0..BOARDS).map(board));
    for _ in 0..QUIET_TIMES {
        match random.within(0..3) {
            0 => rig.power_cycle(random.within(0..BOARDS as u64) as usize),
            1 => {
                rate = random.pick(&RATES);
                switch(&mut rig, rate);
            }
            _ => {}
        }
        rig.collect(Time::from_s(1));
        let frames = rig.collect(Time::from_s(QUIET_S)).0;
        for number in 1..=BOARDS as u16 {
            let sent =
                frames.iter().filter(|frame| frame.cob_id() == 0x700 + number).count() as u64;
            assert!(sent.abs_diff(QUIET_S) <= 1, "board {number} sends {sent} heartbeats in 5 s");
        }
        let others = frames.iter().filter(|frame| frame.cob_id() & 0x780 != 0x700).count();
        assert_eq!(others, 0, "only heartbeats are sent: {frames:?}");
    }
    rig.network.now()
}

/// Switches all boards to `rate` and stores it.
fn switch(rig: &mut ImageRig, rate: BitRate) {
    rig.lss(&format!("04 01, 13 00 {:02X}", rate.index()));
    rig.activate(DELAY_MS as u16);
    rig.network.run_for(Time::from_ms(DELAY_MS));
    rig.set_master_bit_rate(rate);
    rig.collect(Time::from_ms(DELAY_MS + 2));
    let answers = rig.lss("17");
    let answers = answers.0.iter().filter(|frame| frame.cob_id() == 0x7E4);
    assert!(answers.filter(|answer| answer.data()[..2] == [0x17, 0]).count() > 0, "17 is answered");
    rig.collect(Time::from_ms(50));
    rig.lss("04 00");
}
