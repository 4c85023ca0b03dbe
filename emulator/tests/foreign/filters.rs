//! The filter banks (RM0090 32.7.4).

use emulator::can::{Frame, Id};

use crate::{
    command::{Command, EXTENDED, LIST_16, LIST_32, MASK_16, MASK_32, REMOTE},
    rig::{Driver, Rig, extended, standard},
};

/// Sends frames one after the other, and returns the first payload byte of those that each FIFO then has.
fn sorted(rig: &mut Rig, frames: &[Frame]) -> [Vec<u8>; 2] {
    let mut sorted = [Vec::new(), Vec::new()];
    for frame in frames {
        rig.send(*frame);
        rig.run_us(400);
        let fifos = [rig.waiting(0), rig.waiting(1)];
        assert!(fifos.iter().sum::<u32>() <= 1, "{frame} lies in {fifos:?}");
        let received = rig.receive_all();
        assert_eq!(received.len() as u32, fifos.iter().sum::<u32>());
        for (sorted, count) in sorted.iter_mut().zip(fifos) {
            sorted.extend(received.iter().take(count as usize).map(|frame| frame.data[0]));
        }
    }
    assert_eq!(rig.network.adapter_mut(rig.adapter).unsent(), 0, "all are acknowledged");
    sorted
}

const NONE: [Vec<u8>; 2] = [Vec::new(), Vec::new()];

fn joined(driver: Driver, banks: &[(u32, u32, [u32; 4])]) -> Rig {
    let mut rig = Rig::joined(driver, 500_000, 0);
    rig.set_filters(banks);
    rig
}

pub fn without_a_filter_nothing_is_received_but_all_is_acknowledged(driver: Driver) {
    let mut rig = joined(driver, &[]);
    let sorted = sorted(&mut rig, &[standard(0, &[1]), standard(0x7FF, &[2]), extended(5, &[3])]);
    assert_eq!(sorted, NONE);
}

fn frames_around_a_mask() -> [Frame; 5] {
    [
        standard(0x120, &[1]),
        standard(0x12F, &[2]),
        standard(0x130, &[3]),
        standard(0x11F, &[4]),
        extended(0x120 << 18, &[5]),
    ]
}

pub fn a_mask_of_32_bits_sorts_into_fifo_0(driver: Driver) {
    let mut rig = joined(driver, &[(0, MASK_32, [0x120, 0x7F0, 0, 0])]);
    assert_eq!(sorted(&mut rig, &frames_around_a_mask()), [vec![1, 2], vec![]]);
}

pub fn a_mask_of_32_bits_sorts_into_fifo_1(driver: Driver) {
    let mut rig = joined(driver, &[(1, MASK_32, [0x120, 0x7F0, 0, 0])]);
    assert_eq!(sorted(&mut rig, &frames_around_a_mask()), [vec![], vec![1, 2]]);
}

pub fn a_mask_of_32_bits_covers_extended_identifiers(driver: Driver) {
    let id = 0x1234_5600;
    let mut rig = joined(driver, &[(0, MASK_32, [id | EXTENDED, 0x1FFF_FF00, 0, 0])]);
    let frames = [
        extended(id, &[1]),
        extended(id + 0xFF, &[2]),
        extended(id + 0x100, &[3]),
        standard((id >> 18) as u16, &[4]),
    ];
    assert_eq!(sorted(&mut rig, &frames), [vec![1, 2], vec![]]);
}

pub fn two_masks_of_16_bits_share_a_bank_of_fifo_0(driver: Driver) {
    let mut rig = joined(driver, &[(0, MASK_16, [0x120, 0x7F0, 0x700, 0x700])]);
    let mut frames = frames_around_a_mask().to_vec();
    frames.push(standard(0x7AB, &[6]));
    assert_eq!(sorted(&mut rig, &frames), [vec![1, 2, 6], vec![]]);
}

pub fn two_masks_of_16_bits_share_a_bank_of_fifo_1(driver: Driver) {
    let mut rig = joined(driver, &[(1, MASK_16, [0x120, 0x7F0, 0x700, 0x700])]);
    let mut frames = frames_around_a_mask().to_vec();
    frames.push(standard(0x7AB, &[6]));
    assert_eq!(sorted(&mut rig, &frames), [vec![], vec![1, 2, 6]]);
}

fn frames_around_a_list() -> Vec<Frame> {
    [0x100, 0x101, 0x7E5, 0x000, 0x001, 0x605, 0x604, 0x7FF]
        .into_iter()
        .zip(1..)
        .map(|(id, number)| standard(id, &[number]))
        .collect()
}

pub fn a_list_of_16_bits_has_four_identifiers_for_fifo_0(driver: Driver) {
    let mut rig = joined(driver, &[(0, LIST_16, [0x101, 0x7E5, 0, 0x605])]);
    assert_eq!(sorted(&mut rig, &frames_around_a_list()), [vec![2, 3, 4, 6], vec![]]);
}

pub fn a_list_of_16_bits_has_four_identifiers_for_fifo_1(driver: Driver) {
    let mut rig = joined(driver, &[(1, LIST_16, [0x101, 0x7E5, 0, 0x605])]);
    assert_eq!(sorted(&mut rig, &frames_around_a_list()), [vec![], vec![2, 3, 4, 6]]);
}

pub fn a_list_of_32_bits_has_two_identifiers_of_either_kind(driver: Driver) {
    let banks = [
        (0, LIST_32, [0x123, 0x0ABC_DEF0 | EXTENDED, 0, 0]),
        (1, LIST_32, [0x321, 0x0123_4567 | EXTENDED, 0, 0]),
    ];
    let mut rig = joined(driver, &banks);
    let frames = [
        standard(0x123, &[1]),
        extended(0x0ABC_DEF0, &[2]),
        extended(0x0ABC_DEF1, &[3]),
        extended(0x123, &[4]),
        standard(0x321, &[5]),
        extended(0x0123_4567, &[6]),
        standard(0x322, &[7]),
    ];
    assert_eq!(sorted(&mut rig, &frames), [vec![1, 2], vec![5, 6]]);
}

pub fn a_list_tells_remote_frames_from_data_frames(driver: Driver) {
    let banks = [
        (0, LIST_32, [0x123, 0x124 | REMOTE, 0, 0]),
        (1, LIST_16, [0x200 | REMOTE, 0x201, 0x201, 0x201]),
    ];
    let mut rig = joined(driver, &banks);
    for (id, remote, expected) in [
        (0x123, false, [1, 0]),
        (0x123, true, [0, 0]),
        (0x124, false, [0, 0]),
        (0x124, true, [1, 0]),
        (0x200, false, [0, 0]),
        (0x200, true, [0, 1]),
        (0x201, false, [0, 1]),
        (0x201, true, [0, 0]),
    ] {
        let frame = if remote { Frame::remote(Id::Standard(id), 0) } else { standard(id, &[]) };
        rig.send(frame);
        rig.run_us(400);
        assert_eq!([rig.waiting(0), rig.waiting(1)], expected, "{frame}");
        rig.receive_all();
    }
}

pub fn a_filter_of_32_bits_precedes_one_of_16_bits(driver: Driver) {
    let banks = [(0, LIST_16, [0x123; 4]), (1, MASK_32, [0x123, 0x7FF, 0, 0])];
    let mut rig = joined(driver, &banks);
    assert_eq!(sorted(&mut rig, &[standard(0x123, &[1])]), [vec![], vec![1]]);
}

pub fn a_list_precedes_a_mask_of_the_same_width(driver: Driver) {
    for (mask, list) in [(MASK_32, LIST_32), (MASK_16, LIST_16)] {
        let banks = [(0, mask, [0x123, 0x7FF, 0x123, 0x7FF]), (1, list, [0x123; 4])];
        let mut rig = joined(driver, &banks);
        assert_eq!(sorted(&mut rig, &[standard(0x123, &[1])]), [vec![], vec![1]]);
    }
}

pub fn of_equal_filters_the_lower_number_takes_the_frame(driver: Driver) {
    for fifo in [0, 1] {
        let filter = |fifo| (fifo, LIST_32, [0x123, 0x123, 0, 0]);
        let mut rig = joined(driver, &[filter(fifo), filter(1 - fifo)]);
        let mut expected = [vec![], vec![]];
        expected[fifo as usize].push(1);
        assert_eq!(sorted(&mut rig, &[standard(0x123, &[1])]), expected);
    }
}

pub fn filters_can_change_while_the_bus_runs(driver: Driver) {
    let mut rig = Rig::joined(driver, 500_000, 0);
    let frames = [standard(0x100, &[1]), standard(0x200, &[2])];
    assert_eq!(sorted(&mut rig, &frames), [vec![1, 2], vec![]]);
    rig.set_filters(&[(0, LIST_32, [0x200, 0x200, 0, 0])]);
    assert_eq!(sorted(&mut rig, &frames), [vec![2], vec![]]);
    rig.call(Command::ClearFilters, &[]);
    assert_eq!(sorted(&mut rig, &frames), NONE);
}

pub fn the_last_bank_works_like_the_first(driver: Driver) {
    let mut rig = joined(driver, &[]);
    // CAN1 has 14 banks until CAN2SB is changed.
    rig.call(Command::Filter, &[13, 1, LIST_32, 0x123, 0x123]);
    assert_eq!(sorted(&mut rig, &[standard(0x123, &[1])]), [vec![], vec![1]]);
}
