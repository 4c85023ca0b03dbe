//! The two FIFOs (RM0090 32.7.3).

use emulator::can::Frame;

use crate::{
    command::{MASK_32, OVERRUN},
    rig::{Driver, Rig, standard},
};

const RATE: u32 = 500_000;

fn numbered(count: u16) -> Vec<Frame> {
    (0..count).map(|number| standard(0x100 + number, &[number as u8])).collect()
}

fn sent(driver: Driver, frames: &[Frame]) -> Rig {
    let mut rig = Rig::joined(driver, RATE, 0);
    rig.receive_all();
    for frame in frames {
        rig.send(*frame);
    }
    rig.run_us(150 * frames.len() as u64);
    rig
}

pub fn a_fifo_keeps_three_frames_in_their_order_and_a_fourth_replaces_the_newest(driver: Driver) {
    let frames = numbered(4);
    let mut rig = sent(driver, &frames[..3]);
    assert_eq!(rig.waiting(0), 3);
    assert_eq!(rig.receive_all(), frames[..3]);

    let mut rig = sent(driver, &frames);
    assert_eq!(rig.waiting(0), 3);
    // embassy-stm32 does not look at FOVR.
    if driver == Driver::Bxcan {
        assert_eq!(rig.receive(), Err(OVERRUN));
    }
    assert_eq!(rig.receive_all(), [frames[0], frames[1], frames[3]]);
    rig.send(standard(0x123, &[9]));
    rig.run_us(300);
    assert_eq!(rig.receive_all(), [standard(0x123, &[9])], "as before the overrun");
}

/// RM0440 44.3.4.
pub fn a_full_fifo_of_fdcan_keeps_the_first_three_frames(driver: Driver) {
    let frames = numbered(4);
    let mut rig = sent(driver, &frames);
    assert_eq!(rig.waiting(0), 3);
    assert_eq!(rig.receive_all(), frames[..3]);
    rig.send(frames[3]);
    rig.run_us(300);
    assert_eq!(rig.receive_all(), frames[3..]);
}

pub fn a_full_fifo_leaves_the_other_one_room(driver: Driver) {
    let mut rig = Rig::joined(driver, RATE, 0);
    rig.set_filters(&[(0, MASK_32, [0x100, 0x700, 0, 0]), (1, MASK_32, [0x200, 0x700, 0, 0])]);
    for id in [0x100, 0x101, 0x102, 0x103, 0x200, 0x201, 0x202] {
        rig.send(standard(id, &[]));
    }
    rig.run_us(2_000);
    assert_eq!([rig.waiting(0), rig.waiting(1)], [3, 3]);
    let ids = [0x100, 0x101, 0x103, 0x200, 0x201, 0x202];
    assert_eq!(rig.receive_all(), ids.map(|id| standard(id, &[])));
}

pub fn a_burst_of_fifty_frames_arrives_without_loss(driver: Driver) {
    let mut rig = Rig::joined(driver, RATE, 0);
    let frames = numbered(50);
    for frame in &frames {
        rig.send(*frame);
    }
    let mut received = Vec::new();
    rig.wait("the last frame", |rig| {
        received.extend(rig.receive_all());
        received.len() == frames.len()
    });
    assert_eq!(received, frames);
}

pub fn a_frame_interrupts_on_the_line_of_its_fifo(driver: Driver) {
    for fifo in [0, 1] {
        let mut rig = Rig::joined(driver, RATE, 0);
        rig.set_filters(&[(fifo as u32, MASK_32, [0; 4])]);
        rig.receive_all();
        let before = rig.interrupts();
        rig.send(standard(0x123, &[]));
        rig.run_us(300);
        let after = rig.interrupts();
        for line in [1, 2] {
            assert_eq!(after[line] - before[line], u32::from(line == 1 + fifo), "line {line}");
        }
        assert_eq!(rig.receive(), Ok(Some(standard(0x123, &[]))));
    }
}
