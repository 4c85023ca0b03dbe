//! The object dictionary as a tool sees it by SDO (CiA 301, 7.5): the value of each object, and the effect of writes.

use std::panic;

use canopen_node::{
    BusEvent,
    application::{self, Dictionary},
    lss::Address,
    object_dictionary::{DataType, Entry, TABLE},
};
use testkit::{
    flash::BoardFlash,
    node_rig::{NodeRig, defaults},
    random::Random,
    sdo::Client,
};

use crate::process_data::Machine;

const DOES_NOT_EXIST: u32 = 0x0602_0000;
const NO_SUB_INDEX: u32 = 0x0609_0011;
const INVALID_VALUE: u32 = 0x0609_0030;
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
fn writing_0_clears_the_error_history_and_any_other_number_is_refused() {
    let (mut board, _) = history_of(3);
    for number in 1..=u8::MAX {
        assert_eq!(board.download(0x1003, 0, &[number]), Err(INVALID_VALUE));
    }
    assert_eq!(board.number(0x1003, 0), 3);
    // Without its size, the data behind the byte does not count.
    assert_eq!(board.sdo("22 03 10 00 00 FF FF FF"), ["5C0: 60 03 10 00 00 00 00 00"]);
    assert_eq!(board.number(0x1003, 0), 0);
    assert_eq!(board.upload(0x1003, 1), Err(NO_DATA));
    board.report(BusEvent::Overrun);
    board.pass_us(0);
    assert_eq!(board.number(0x1003, 0), 1, "it continues");
}

#[test]
fn the_error_behaviour_takes_0_1_and_2_and_refuses_the_rest() {
    let mut board = NodeRig::with_node_id(0x40);
    for value in [1, 2, 0, 2] {
        board.download(0x1029, 1, &[value]).unwrap();
        assert_eq!(board.number(0x1029, 1), u32::from(value));
    }
    for value in 3..=u8::MAX {
        assert_eq!(board.download(0x1029, 1, &[value]), Err(INVALID_VALUE));
    }
    assert_eq!(board.number(0x1029, 1), 2);
    assert_eq!(board.sdo("22 29 10 01 01 FF FF FF"), ["5C0: 60 29 10 01 00 00 00 00"]);
    assert_eq!(board.number(0x1029, 1), 1);
}

#[test]
fn the_error_behaviour_is_stored_and_restored() {
    let mut board = NodeRig::with_node_id(0x40);
    board.download(0x1029, 1, &[2]).unwrap();
    board.nmt("82 00");
    assert_eq!(board.number(0x1029, 1), 0);
    board.download(0x1029, 1, &[2]).unwrap();
    board.save(1).unwrap();
    board.nmt("82 00");
    assert_eq!(board.number(0x1029, 1), 2);
    board.download(0x1029, 1, &[1]).unwrap();
    board.power_cycle();
    assert_eq!(board.number(0x1029, 1), 2);
    board.load(1).unwrap();
    board.power_cycle();
    assert_eq!(board.number(0x1029, 1), 0);
}

#[test]
fn a_new_device_has_these_values() {
    let mut board = NodeRig::with_node_id(0x40);
    for (index, sub_index, value) in [
        (0x1000, 0, 0),
        (0x1001, 0, 0),
        (0x1003, 0, 0),
        (0x1029, 0, 1),
        (0x1029, 1, 0),
        (0x1200, 0, 2),
        (0x1200, 1, 0x640),
        (0x1200, 2, 0x5C0),
        (0x2000, 0, 9),
        (0x2000, 8, 0),
        (0x2000, 9, 0),
    ] {
        assert_eq!(board.number(index, sub_index), value, "{index:04X} sub {sub_index}");
    }
    assert_eq!(board.upload(0x1008, 0).unwrap(), b"Test board");
    assert_eq!(board.upload(0x1009, 0).unwrap(), b"A");
    assert_eq!(board.upload(0x100A, 0).unwrap(), b"1.2.3");
}

#[test]
fn a_heartbeat_time_that_is_written_counts_from_the_write() {
    let mut board = NodeRig::with_heartbeat(0x40, 100);
    board.pass_ms(60);
    board.download(0x1017, 0, &[50, 0]).unwrap();
    assert_eq!(board.pass_us(49_999), []);
    assert_eq!(board.pass_us(1), ["740: 7F"]);
    assert_eq!(board.pass_ms(50), ["740: 7F"]);
    board.download(0x1017, 0, &[0, 0]).unwrap();
    assert_eq!(board.pass_ms(100_000), [], "0: no heartbeat");
    board.download(0x1017, 0, &[10, 0]).unwrap();
    assert_eq!(board.pass_ms(9), []);
    assert_eq!(board.pass_ms(1), ["740: 7F"]);
}

#[test]
fn the_identity_object_is_the_lss_address() {
    let mut random = Random::from_environment();
    for _ in 0..100 {
        let address = Address {
            vendor_id: random.u32(),
            product_code: random.u32(),
            revision_number: random.u32(),
            serial_number: random.u32(),
        };
        let mut board = NodeRig::new(address, defaults(0x40), BoardFlash::blank(0), 0);
        board.lss("04 01");
        assert_eq!(board.number(0x1018, 0), 4);
        for (inquire, sub_index) in [("5A", 1), ("5B", 2), ("5C", 3), ("5D", 4)] {
            let by_sdo = board.upload(0x1018, sub_index).unwrap();
            assert_eq!(by_sdo, board.lss(inquire).0[0].data()[1..5], "sub-index {sub_index}");
        }
        assert_eq!(board.number(0x1018, 1), address.vendor_id);
        assert_eq!(board.number(0x1018, 4), address.serial_number);
    }
}

#[test]
fn every_other_index_does_not_exist() {
    let mut board = NodeRig::with_node_id(0x40);
    for index in 0..=u16::MAX {
        if TABLE.iter().all(|entry| entry.index != index) {
            assert_eq!(board.upload(index, 0), Err(DOES_NOT_EXIST), "{index:04X}");
        }
    }
}

#[test]
fn every_other_sub_index_of_an_object_does_not_exist() {
    let mut board = NodeRig::with_node_id(0x40);
    for Entry { index, .. } in TABLE {
        for sub_index in 0..=u8::MAX {
            let is_there = |e: &Entry| e.index == *index && e.sub_index == sub_index;
            if !TABLE.iter().any(is_there) {
                assert_eq!(board.upload(*index, sub_index), Err(NO_SUB_INDEX));
                assert_eq!(board.download(*index, sub_index, &[0]), Err(NO_SUB_INDEX));
            }
        }
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
    application::check(&objects[..256]);
    assert!(panic::catch_unwind(|| application::check(&objects)).is_err());
}
