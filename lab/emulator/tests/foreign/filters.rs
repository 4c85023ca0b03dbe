//! The filter banks (RM0090 32.7.4).

use emulator::can::{Frame, Id};

use crate::{
    command::{CLEAR_FILTERS, EXTENDED, FILTER, LIST_16, LIST_32, MASK_16, MASK_32, REMOTE},
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

fn joined(driver: Driver, banks: &[Bank]) -> Rig {
    let mut rig = Rig::joined(driver, 500_000, 0);
    rig.set_filters(banks);
    rig
}

/// FIFO, kind and words of a bank.
type Bank = (u32, u32, [u32; 4]);

/// Checks which frames lie in the two FIFOs after the frames numbered from 1 on were sent.
fn check(driver: Driver, banks: &[Bank], frames: &[Frame], expected: [&[u8]; 2]) {
    let mut rig = joined(driver, banks);
    assert_eq!(sorted(&mut rig, frames), expected, "{banks:x?}");
}

/// The same with the bank in FIFO 0 and then in FIFO 1.
fn check_both(driver: Driver, kind: u32, words: [u32; 4], frames: &[Frame], expected: &[u8]) {
    check(driver, &[(0, kind, words)], frames, [expected, &[]]);
    check(driver, &[(1, kind, words)], frames, [&[], expected]);
}

pub fn without_a_filter_nothing_is_received_but_all_is_acknowledged(driver: Driver) {
    let frames = [standard(0, &[1]), standard(0x7FF, &[2]), extended(5, &[3])];
    check(driver, &[], &frames, [&[], &[]]);
}

pub fn masks_of_32_and_of_16_bits_sort_into_either_fifo(driver: Driver) {
    let frames = [
        standard(0x120, &[1]),
        standard(0x12F, &[2]),
        standard(0x130, &[3]),
        standard(0x11F, &[4]),
        extended(0x120 << 18, &[5]),
        standard(0x7AB, &[6]),
    ];
    check_both(driver, MASK_32, [0x120, 0x7F0, 0, 0], &frames, &[1, 2]);
    check_both(driver, MASK_16, [0x120, 0x7F0, 0x700, 0x700], &frames, &[1, 2, 6]);
}

pub fn a_mask_of_32_bits_covers_extended_identifiers(driver: Driver) {
    let id = 0x1234_5600;
    let frames = [
        extended(id, &[1]),
        extended(id + 0xFF, &[2]),
        extended(id + 0x100, &[3]),
        standard((id >> 18) as u16, &[4]),
    ];
    check(driver, &[(0, MASK_32, [id | EXTENDED, 0x1FFF_FF00, 0, 0])], &frames, [&[1, 2], &[]]);
}

pub fn a_list_of_16_bits_has_four_identifiers_for_either_fifo(driver: Driver) {
    let ids = [0x100, 0x101, 0x7E5, 0x000, 0x001, 0x605, 0x604, 0x7FF];
    let frames: Vec<Frame> =
        ids.into_iter().zip(1..).map(|(id, number)| standard(id, &[number])).collect();
    check_both(driver, LIST_16, [0x101, 0x7E5, 0, 0x605], &frames, &[2, 3, 4, 6]);
}

pub fn a_list_of_32_bits_has_two_identifiers_of_either_kind(driver: Driver) {
    let banks = [
        (0, LIST_32, [0x123, 0x0ABC_DEF0 | EXTENDED, 0, 0]),
        (1, LIST_32, [0x321, 0x0123_4567 | EXTENDED, 0, 0]),
    ];
    let frames = [
        standard(0x123, &[1]),
        extended(0x0ABC_DEF0, &[2]),
        extended(0x0ABC_DEF1, &[3]),
        extended(0x123, &[4]),
        standard(0x321, &[5]),
        extended(0x0123_4567, &[6]),
        standard(0x322, &[7]),
    ];
    check(driver, &banks, &frames, [&[1, 2], &[5, 6]]);
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

pub fn of_several_filters_the_wider_then_the_list_then_the_lower_number_takes_the_frame(
    driver: Driver,
) {
    let mask = [0x123, 0x7FF, 0x123, 0x7FF];
    let list = [0x123; 4];
    for [loser, winner] in [
        [(0, LIST_16, list), (1, MASK_32, mask)],
        [(0, MASK_32, mask), (1, LIST_32, list)],
        [(0, MASK_16, mask), (1, LIST_16, list)],
    ] {
        check(driver, &[loser, winner], &[standard(0x123, &[1])], [&[], &[1]]);
    }
    check(driver, &[(0, LIST_32, list), (1, LIST_32, list)], &[standard(0x123, &[1])], [&[1], &[]]);
    check(driver, &[(1, LIST_32, list), (0, LIST_32, list)], &[standard(0x123, &[1])], [&[], &[1]]);
}

pub fn filters_can_change_while_the_bus_runs(driver: Driver) {
    let mut rig = Rig::joined(driver, 500_000, 0);
    let frames = [standard(0x100, &[1]), standard(0x200, &[2])];
    assert_eq!(sorted(&mut rig, &frames), [vec![1, 2], vec![]]);
    rig.set_filters(&[(0, LIST_32, [0x200, 0x200, 0, 0])]);
    assert_eq!(sorted(&mut rig, &frames), [vec![2], vec![]]);
    rig.call(CLEAR_FILTERS, &[]);
    assert_eq!(sorted(&mut rig, &frames).concat(), b"");
}

pub fn the_last_bank_works_like_the_first(driver: Driver) {
    let mut rig = joined(driver, &[]);
    // CAN1 has 14 banks until CAN2SB is changed.
    rig.call(FILTER, &[13, 1, LIST_32, 0x123, 0x123]);
    assert_eq!(sorted(&mut rig, &[standard(0x123, &[1])]), [vec![], vec![1]]);
}
