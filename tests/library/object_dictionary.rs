//! The object dictionary as a tool sees it by SDO (CiA 301, 7.5): the value of each object, and the effect of writes.

use std::panic;

use canopen_node::{
    BusEvent,
    application::Dictionary,
    object_dictionary::{DataType, Entry},
    private,
};
use testkit::{node_rig::NodeRig, sdo::Client};

use crate::process_data::Machine;

const NO_SUB_INDEX: u32 = 0x0609_0011;
const NO_DATA: u32 = 0x0800_0024;

#[test]
fn faults_and_error_counters_of_the_can_controller_can_be_read() {
    let mut board = NodeRig::with_node_id(0x40);
    for sub_index in 1..=4 {
        assert_eq!(board.number(0x2000, sub_index), 0);
    }
    for fault in [BusEvent::BusOffRecovered, BusEvent::Overrun, BusEvent::Overrun] {
        board.report(fault);
    }
    board.report(BusEvent::ErrorCounters { transmit: 136, receive: 9 });
    board.pass_us(0);
    let read = [1, 2, 3, 4].map(|sub_index| board.number(0x2000, sub_index));
    assert_eq!(read, [1, 2, 136, 9]);
}

/// The error history after this number of overruns and recoveries from bus-off, in turn.
fn history_of(faults: usize) -> (NodeRig, Vec<Vec<u8>>) {
    let mut board = NodeRig::with_node_id(0x40);
    for fault in [BusEvent::Overrun, BusEvent::BusOffRecovered].into_iter().cycle().take(faults) {
        board.report(fault);
        board.pass_us(0);
    }
    let number = board.number(0x1003, 0) as u8;
    let history = (1..=number).map(|sub_index| board.upload(0x1003, sub_index).unwrap()).collect();
    (board, history)
}

#[test]
fn the_error_history_holds_the_last_eight_errors_the_newest_first() {
    const OVERRUN: [u8; 4] = [0x10, 0x81, 0, 0];
    const RECOVERED: [u8; 4] = [0x40, 0x81, 0, 0];
    for faults in 0..20 {
        let (mut board, history) = history_of(faults);
        let newest_first = (0..faults).rev();
        let expected: Vec<_> = newest_first
            .map(|n| if n.is_multiple_of(2) { OVERRUN } else { RECOVERED })
            .take(8)
            .collect();
        assert_eq!(history, expected, "{faults}");
        for sub_index in faults as u8 + 1..=8 {
            assert_eq!(board.upload(0x1003, sub_index), Err(NO_DATA), "{faults}, {sub_index}");
        }
        assert_eq!(board.upload(0x1003, 9), Err(NO_SUB_INDEX));
    }
}

#[test]
fn an_integer_type_reaches_from_its_lowest_to_its_highest_number() {
    use DataType::*;
    let signed = [
        (Integer8, 8),
        (Integer16, 16),
        (Integer24, 24),
        (Integer32, 32),
        (Integer40, 40),
        (Integer48, 48),
        (Integer56, 56),
        (Integer64, 64),
    ];
    let unsigned = [
        (Unsigned8, 8),
        (Unsigned16, 16),
        (Unsigned24, 24),
        (Unsigned32, 32),
        (Unsigned40, 40),
        (Unsigned48, 48),
        (Unsigned56, 56),
        (Unsigned64, 64),
    ];
    let signed = signed.map(|(of, bits)| (of, -(1_i128 << (bits - 1)), (1 << (bits - 1)) - 1));
    let unsigned = unsigned.map(|(of, bits)| (of, 0, (1_i128 << bits) - 1));
    for (of, low, high) in signed.into_iter().chain(unsigned) {
        assert!(of.reaches(low, high), "{of:?}");
        assert!(!of.reaches(low - 1, high) && !of.reaches(low, high + 1), "{of:?}");
    }
    assert!([Boolean, Real64, VisibleString].iter().all(|of| of.reaches(i128::MIN, i128::MAX)));
}

#[test]
fn a_product_has_at_most_256_objects() {
    let object = |number: u16| Entry { index: 0x2001 + number, ..Machine::OBJECTS[0] };
    let objects: Vec<_> = (0..257).map(object).collect();
    private::check(&objects[..256]);
    assert!(panic::catch_unwind(|| private::check(&objects)).is_err());
}
