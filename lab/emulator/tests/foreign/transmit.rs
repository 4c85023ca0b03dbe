//! The three mailboxes (RM0090 32.7.1), and one-shot transmission (32.7.1, NART).

use emulator::can::{Frame, Id};

use crate::{
    command::ONE_SHOT,
    rig::{Driver, Rig, extended, standard},
};

/// At this rate commands are quick in comparison to a frame.
const RATE: u32 = 125_000;

/// A board on a bus that has just begun to carry a long frame.
fn on_a_busy_bus(driver: Driver, modes: u32) -> Rig {
    let mut rig = Rig::joined(driver, RATE, modes);
    rig.send(standard(0, &[0; 8]));
    rig.run_us(100);
    rig
}

pub fn mailboxes_go_by_identifier_then_standard_then_data(driver: Driver) {
    let by_priority = [
        vec![standard(0x100, &[1]), standard(0x200, &[2]), standard(0x300, &[3])],
        vec![standard(0x001, &[]), standard(0x7FF, &[])],
        vec![standard(0x123, &[2]), extended(0x123 << 18, &[1])],
        vec![standard(0x123, &[2]), Frame::remote(Id::Standard(0x123), 0)],
    ];
    for frames in by_priority {
        let mut rig = on_a_busy_bus(driver, 0);
        for (frame, mailbox) in frames.iter().rev().zip(0..) {
            assert_eq!(rig.transmit(*frame), Some((mailbox, None)), "the lowest number");
        }
        assert!(!rig.is_idle());
        rig.run_us(5_000);
        assert!(rig.is_idle());
        assert_eq!(rig.heard(), frames);
    }
}

pub fn three_frames_leave_without_a_gap(driver: Driver) {
    let mut rig = on_a_busy_bus(driver, 0);
    let frames = [0x300, 0x200, 0x100].map(|id| standard(id, &[1, 2, 3, 4, 5, 6, 7, 8]));
    for frame in frames {
        rig.transmit(frame);
    }
    rig.run_us(6_000);
    let times: Vec<u64> = std::iter::from_fn(|| rig.network.receive(rig.adapter))
        .map(|(time, _)| time.as_us())
        .collect();
    let bits = |frame: Frame| u64::from(frame.wire_bits()) + 3;
    let expected = [frames[1], frames[0]].map(|frame| bits(frame) * 8);
    for (pair, expected) in times.windows(2).zip(expected) {
        assert!((pair[1] - pair[0]).abs_diff(expected) <= 8, "{pair:?}, expected {expected}");
    }
    assert_eq!(times.len(), 3);
}

pub fn an_identifier_that_waits_is_refused_a_second_time(driver: Driver) {
    let mut rig = on_a_busy_bus(driver, 0);
    assert_eq!(rig.transmit(standard(0x123, &[1])), Some((0, None)));
    assert_eq!(rig.transmit(standard(0x123, &[2])), None);
    rig.run_us(3_000);
    assert_eq!(rig.transmit(standard(0x123, &[3])), Some((0, None)));
}

pub fn a_fourth_frame_takes_the_place_of_the_least_urgent(driver: Driver) {
    let mut rig = on_a_busy_bus(driver, 0);
    let frames = [0x300, 0x700, 0x200, 0x100];
    let [a, b, c, d] = frames.map(|id| standard(id, &[id as u8, 1, 2]));
    // The crate bxcan refuses a frame that is less urgent than one that waits.
    let order = if driver == Driver::Bxcan { [b, a, c] } else { [a, b, c] };
    for frame in order {
        assert_ne!(rig.transmit(frame), None);
    }
    let replaced = rig.transmit(d).and_then(|(_, replaced)| replaced);
    assert_eq!(replaced, Some(b));
    rig.run_us(5_000);
    assert_eq!(rig.heard(), [d, c, a]);
}

/// The comparison of embassy-stm32 0.6.0 is the wrong way round.
pub fn a_full_queue_gives_up_a_more_urgent_frame_for_a_less_urgent_one(driver: Driver) {
    let mut rig = on_a_busy_bus(driver, 0);
    let frames = [0x300, 0x200, 0x400].map(|id| standard(id, &[id as u8]));
    for frame in frames {
        assert!(matches!(rig.transmit(frame), Some((_, None))));
    }
    assert_eq!(rig.transmit(standard(0x100, &[])), None);
    let (_, replaced) = rig.transmit(standard(0x310, &[])).expect("it takes it");
    assert_eq!(replaced, Some(frames[0]));
    rig.run_us(5_000);
    assert_eq!(rig.heard(), [frames[1], standard(0x310, &[]), frames[2]]);
}

pub fn a_frame_that_waits_can_be_aborted_and_an_empty_mailbox_cannot(driver: Driver) {
    let mut rig = on_a_busy_bus(driver, 0);
    assert!((0..3).all(|mailbox| !rig.abort(mailbox)));
    let [a, b] = [0x300, 0x200].map(|id| standard(id, &[]));
    rig.transmit(a);
    rig.transmit(b);
    assert!(rig.abort(0));
    rig.run_us(4_000);
    assert_eq!(rig.heard(), [b]);
}

pub fn a_frame_under_way_is_sent_in_spite_of_an_abort(driver: Driver) {
    let mut rig = Rig::joined(driver, RATE, 0);
    let frame = standard(0x300, &[1, 2, 3]);
    rig.transmit(frame);
    rig.wait("the frame", |rig| rig.is_transmitting());
    let aborted = rig.abort(0);
    rig.run_us(1_000);
    assert_eq!(rig.heard(), [frame]);
    // The interrupt handler of embassy-stm32 clears TXOK before the driver looks at it.
    assert_eq!(aborted, driver == Driver::Embassy);
}

pub fn the_end_of_a_transmission_interrupts(driver: Driver) {
    let mut rig = Rig::joined(driver, RATE, 0);
    rig.receive_all();
    let [before, ..] = rig.interrupts();
    rig.transmit(standard(0x300, &[1]));
    rig.wait("the frame", |rig| rig.is_transmitting());
    assert_eq!(rig.interrupts()[0], before);
    rig.run_us(1_000);
    assert_eq!(rig.interrupts()[0], before + 1);
}

pub fn a_frame_that_loses_the_arbitration_is_sent_afterwards(driver: Driver) {
    let mut rig = on_a_busy_bus(driver, 0);
    let (urgent, other) = (standard(0x010, &[1]), standard(0x011, &[2]));
    let second = rig.add_adapter(RATE);
    rig.send(urgent);
    rig.transmit(other);
    rig.run_us(5_000);
    let heard: Vec<Frame> =
        std::iter::from_fn(|| rig.network.receive(second)).map(|(_, frame)| frame).collect();
    assert_eq!(heard.last_chunk(), Some(&[urgent, other]));
    assert_eq!(rig.error_counters(), (0, 0));
}

pub fn one_shot_gives_up_after_a_lost_arbitration(driver: Driver) {
    let mut rig = on_a_busy_bus(driver, ONE_SHOT);
    rig.send(standard(0x010, &[1]));
    rig.transmit(standard(0x011, &[2]));
    rig.run_us(5_000);
    assert!(rig.is_idle());
    assert_eq!(rig.heard(), []);
    assert_eq!(rig.error_counters(), (0, 0));
}

pub fn one_shot_sends_once_whether_or_not_somebody_acknowledges(driver: Driver) {
    let frame = standard(0x123, &[1]);
    for (is_acknowledged, transmit_errors) in [(true, 0), (false, 8)] {
        let mut rig = Rig::joined(driver, RATE, ONE_SHOT);
        if !is_acknowledged {
            rig.network.adapter_mut(rig.adapter).close();
        }
        rig.transmit(frame);
        rig.run_us(2_000);
        assert!(rig.is_idle());
        assert_eq!(rig.heard() == [frame], is_acknowledged);
        assert_eq!(rig.error_counters(), (transmit_errors, 0));
    }
}
