//! Stored parameters: what 1010h stores and 1011h restores of a node with an application, over power cycles, resets and
//! another firmware.

use canopen_node::{
    Application,
    application::{Event, Text},
    lss::StoreError,
    objects,
    sdo::Abort,
    settings::{Found, parameters},
};
use testkit::{
    flash::{BoardFlash, Operation},
    frames::SILENCE,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::Client,
};

objects! {
    /// A pump, first version.
    pub struct Pump, values PumpValue;

    0x2100 {
        0 "Speed" speed: u16 = 100, rw in 10..=1000, stored;
    }
    0x2101 "Limits" {
        1 "Lowest" lowest: i8 = -5, rw, stored;
        2 "Highest" highest: i32 = 500, rw, stored;
        3 "Not stored" volatile: u8 = 7, rw;
        4 "Meter" meter: u64 = 1, ro, stored;
    }
    0x6000 {
        0 "Label" label: Text<12> = Text::EMPTY, rw, stored;
    }
    0x6001 {
        0 "Enabled" enabled: bool = false, rw, stored;
    }
}

impl Application for Pump {
    fn accept(&mut self, value: &PumpValue) -> Result<(), Abort> {
        match value {
            PumpValue::Highest(600) => Err(Abort::DeviceState),
            _ => Ok(()),
        }
    }

    fn handle(&mut self, _: Event) {}
}

objects! {
    /// The same pump in a later version: one value has another type, one other limits, one is shorter, one is no longer
    /// stored, one is new, one is gone.
    pub struct NewPump, values NewPumpValue;

    0x2100 {
        0 "Speed" speed: u16 = 100, rw in 10..=300, stored;
    }
    0x2101 "Limits" {
        1 "Lowest" lowest: i16 = -50, rw, stored;
        2 "Highest" highest: i32 = 500, rw, stored;
        5 "New" new: u32 = 55, rw, stored;
    }
    0x2200 "Many" {
        1 "1" m1: u64 = 1, rw, stored;
        2 "2" m2: u64 = 2, rw, stored;
        3 "3" m3: u64 = 3, rw, stored;
        4 "4" m4: u64 = 4, rw, stored;
    }
    0x6000 {
        0 "Label" label: Text<3> = Text::EMPTY, rw, stored;
    }
    0x6001 {
        0 "Enabled" enabled: bool = false, rw;
    }
}

impl Application for NewPump {}

objects! {
    /// An application that stores a single byte.
    pub struct Small, values SmallValue;

    0x6001 {
        0 "Enabled" enabled: bool = false, rw, stored;
    }
}

impl Application for Small {}

/// The bytes of a stored value beside it.
const HEADER: usize = 6;
const FAILED: Result<(), u32> = Err(0x0606_0000);

fn board_with<A: Application + Clone>(flash: &BoardFlash, application: A) -> NodeRig<A> {
    let device = device(ADDRESS).with_defaults(defaults(0x40)).with_heartbeat_ms(500);
    NodeRig::with_application(device, flash.clone(), 0, application)
}

/// A new board with a pump and node-ID 40h.
fn board() -> NodeRig<Pump> {
    board_with(&BoardFlash::blank(0), Pump::new())
}

/// A board whose speed is 200 and whose heartbeat time is 1000 ms, both stored, and then 300 and 2000 ms.
fn board_with_200_stored_and_300_set() -> NodeRig<Pump> {
    let mut board = board();
    set(&mut board, 200, 1000);
    board.save(1).unwrap();
    set(&mut board, 300, 2000);
    board
}

fn set(board: &mut NodeRig<Pump>, speed: u16, heartbeat_ms: u16) {
    board.download(0x2100, 0, &speed.to_le_bytes()).unwrap();
    board.download(0x1017, 0, &heartbeat_ms.to_le_bytes()).unwrap();
}

/// The speed and the heartbeat time.
fn values(board: &mut NodeRig<Pump>) -> (u32, u32) {
    (board.number(0x2100, 0), board.number(0x1017, 0))
}

#[test]
fn store_and_restore_have_three_sub_indices_and_act_on_command() {
    fn check(client: &mut impl Client) {
        for index in [0x1010, 0x1011] {
            assert_eq!(client.upload(index, 0), Ok(vec![3]));
            for sub_index in 1..=3 {
                assert_eq!(client.number(index, sub_index), 1, "on command");
                assert_eq!(client.download(index, sub_index, b"evas"), Err(0x0800_0020));
            }
            assert_eq!(client.upload(index, 4), Err(0x0609_0011));
        }
    }
    check(&mut board());
    check(&mut NodeRig::with_node_id(0x40));
}

#[test]
fn stored_values_of_each_type_survive_a_power_cycle() {
    let mut board = board();
    let pump = board.node.application_mut();
    (pump.speed, pump.lowest, pump.highest) = (200, -1, -70_000);
    (pump.volatile, pump.meter, pump.enabled) = (8, 0x1122_3344_5566_7788, true);
    pump.label = Text::from_bytes(b"Main pump").unwrap();
    assert_eq!(board.save(1), Ok(()));
    board.power_cycle();
    assert_eq!(board.found, Found::Complete);
    let pump = board.node.application();
    assert_eq!((pump.speed, pump.lowest, pump.highest), (200, -1, -70_000));
    assert_eq!((pump.meter, pump.enabled), (0x1122_3344_5566_7788, true));
    assert_eq!(pump.label.as_str(), "Main pump");
    assert_eq!(pump.volatile, 7, "this one is not stored");
}

#[test]
fn values_that_were_not_saved_are_lost_at_the_next_reset_of_their_part() {
    for (reset, left) in [("81 00", (200, 1000)), ("82 00", (300, 1000))] {
        let mut board = board_with_200_stored_and_300_set();
        board.nmt(reset);
        assert_eq!(values(&mut board), left, "{reset}");
        set(&mut board, 300, 2000);
        board.power_cycle();
        assert_eq!(values(&mut board), (200, 1000));
    }
}

#[test]
fn save_and_load_of_sub_index_1_2_or_3_concern_their_part_from_the_next_reset_on() {
    for (index, sub_index, then) in [
        (0x1010, 1, (300, 2000)),
        (0x1010, 2, (200, 2000)),
        (0x1010, 3, (300, 1000)),
        (0x1011, 1, (100, 500)),
        (0x1011, 2, (200, 500)),
        (0x1011, 3, (100, 1000)),
    ] {
        let mut board = board_with_200_stored_and_300_set();
        let signature = if index == 0x1010 { b"save" } else { b"load" };
        assert_eq!(board.download(index, sub_index, signature), Ok(()));
        assert_eq!(values(&mut board), (300, 2000), "nothing changes before the reset");
        board.nmt("81 00");
        assert_eq!(values(&mut board), then, "{index:X} sub-index {sub_index}");
        board.power_cycle();
        assert_eq!(values(&mut board), then, "{index:X} sub-index {sub_index}");
    }
}

#[test]
fn a_store_by_lss_keeps_the_parameters_and_writes_one_record() {
    let mut board = board_with_200_stored_and_300_set();
    let parameters = board.stored_parameters().to_vec();
    let writes = board.flash.writes();
    board.configure("11 41");
    assert_eq!(board.lss("17"), ["17 00"]);
    assert_eq!(board.flash.writes(), writes + 10, "one record in a place of ten words");
    assert_eq!(board.stored_parameters(), parameters);
    board.power_cycle();
    assert_eq!(
        (board.stored().unwrap().node_id.unwrap().get(), board.found),
        (0x41, Found::Complete)
    );
    assert_eq!((board.node.application().speed, board.number(0x1017, 0)), (200, 1000));
}

#[test]
fn unchanged_parameters_are_not_written() {
    let mut board = board_with_200_stored_and_300_set();
    board.save(1).unwrap();
    for sub_index in [1, 2, 3] {
        let writes = board.flash.writes();
        assert_eq!(board.save(sub_index), Ok(()));
        assert_eq!(board.flash.writes(), writes, "sub-index {sub_index}");
    }
    board.power_cycle();
    let writes = board.flash.writes();
    assert_eq!(board.save(1), Ok(()));
    assert_eq!(board.flash.writes(), writes, "after a power cycle");
    board.download(0x1017, 0, &[1, 0]).unwrap();
    assert_eq!(board.save(1), Ok(()));
    assert_eq!(board.flash.writes(), writes + 37, "three parts, and the record");
}

#[test]
fn the_values_are_those_of_the_moment_at_which_the_board_begins_to_store() {
    let mut board = board();
    board.let_stores_take_time();
    set(&mut board, 200, 1000);
    assert_eq!(board.sdo("23 10 10 01 73 61 76 65"), SILENCE, "the answer follows the store");
    set(&mut board, 250, 2000);
    board.begin_store_late();
    set(&mut board, 300, 3000);
    assert_eq!(board.finish_store(), ["5C0: 60 10 10 01 00 00 00 00"]);
    board.power_cycle();
    assert_eq!(values(&mut board), (250, 2000));
}

#[test]
fn a_save_of_the_application_keeps_the_heartbeat_time_of_a_save_before_it() {
    let mut board = board();
    board.let_stores_take_time();
    set(&mut board, 200, 1000);
    board.sdo("23 10 10 02 73 61 76 65");
    assert_eq!(board.sdo("23 10 10 03 73 61 76 65"), SILENCE, "it waits for the other store");
    board.finish_store();
    board.finish_store();
    board.power_cycle();
    assert_eq!(values(&mut board), (200, 1000));
}

#[test]
fn a_save_that_fails_is_answered_0606_0000_and_old_values_stay() {
    for operation in [Operation::Write, Operation::Read] {
        for others in 0.. {
            let mut board = board_with_200_stored_and_300_set();
            board.flash.fail_once(operation, others);
            let outcome = board.save(1);
            if board.flash.is_faulty() {
                break;
            }
            board.power_cycle();
            let stored = if outcome.is_ok() { (300, 2000) } else { (200, 1000) };
            assert_eq!(values(&mut board), stored, "{operation:?} {others}: {outcome:?}");
            assert!(outcome == FAILED || outcome == Ok(()));
        }
    }
    for reason in [StoreError::MediumAccess, StoreError::NotSupported] {
        let mut board = board();
        board.let_stores_take_time();
        for (request, abort) in [
            ("23 10 10 03 73 61 76 65", "5C0: 80 10 10 03 00 00 06 06"),
            ("23 11 10 01 6C 6F 61 64", "5C0: 80 11 10 01 00 00 06 06"),
        ] {
            board.sdo(request);
            assert_eq!(board.end_store(Err(reason)), [abort]);
        }
    }
}

#[test]
fn a_save_into_a_full_flash_is_0800_0022_and_the_next_start_makes_room() {
    let mut board = board();
    let mut speed = 10;
    let full = loop {
        board.download(0x2100, 0, &u16::to_le_bytes(speed)).unwrap();
        let outcome = board.save(3);
        if outcome.is_err() {
            break outcome;
        }
        speed += 1;
    };
    assert_eq!(full, Err(0x0800_0022));
    // The parameters take three places, and a record follows. Each of two banks has 401 places for stores, and one has
    // three records of the defaults.
    assert_eq!(speed - 10, 398 / 4 + 401 / 4);
    let erases = board.flash.erases();
    board.power_cycle();
    assert_eq!(
        (board.flash.erases(), board.found),
        (erases + 2, Found::Complete),
        "both were full"
    );
    assert_eq!(board.number(0x2100, 0), u32::from(speed) - 1);
    board.download(0x2100, 0, &speed.to_le_bytes()).unwrap();
    assert_eq!(board.save(3), Ok(()));
}

#[test]
fn another_firmware_takes_the_values_whose_type_and_limits_agree() {
    let mut old = board();
    let pump = old.node.application_mut();
    (pump.speed, pump.lowest, pump.highest, pump.enabled) = (500, -1, 600, true);
    pump.label = Text::from_bytes(b"Main pump").unwrap();
    old.save(1).unwrap();
    let board = board_with(&old.flash, NewPump::new());
    assert_eq!(board.found, Found::Complete);
    let new = board.node.application();
    assert_eq!(new.speed, 100, "500 is out of its limits");
    assert_eq!(new.lowest, -50, "it has another type");
    assert_eq!(new.highest, 600, "which accept would have refused from a client");
    assert_eq!((new.new, new.m1, new.m4), (55, 1, 4), "they are new");
    assert_eq!(new.label, Text::EMPTY, "it is too long");
    assert!(!new.enabled, "it is no longer stored");
    let board = board_with(&old.flash, Small::new());
    assert!(board.node.application().enabled, "the other values do not fit in the buffer");
    assert_eq!(board.stored_parameters().len(), HEADER + 2 + HEADER + 1);
}

#[test]
fn values_unknown_to_a_firmware_outlast_its_stores_by_lss() {
    let mut old = board_with_200_stored_and_300_set();
    old.node.application_mut().enabled = true;
    old.save(1).unwrap();
    let mut other = board_with(&old.flash, Small::new());
    other.lss("04 01");
    // Enough to move to the other bank at the next start.
    for n in 0..500 {
        other.lss(&format!("11 {:02X}", n % 64 + 1));
        assert_eq!(other.lss("17"), ["17 00"]);
    }
    other.power_cycle();
    assert_eq!(board_with(&old.flash, Pump::new()).node.application().speed, 300);
    // A store of its own parameters replaces them.
    let mut other = board_with(&old.flash, Small::new());
    other.node.application_mut().enabled = false;
    other.configure("11 40, 17");
    other.power_cycle();
    other.node.application_mut().enabled = false;
    other.save(3).unwrap();
    assert_eq!(board_with(&old.flash, Pump::new()).node.application().speed, 100);
}

#[test]
fn a_node_without_an_application_replaces_the_parameters_when_it_saves() {
    let mut board = board_with_200_stored_and_300_set();
    let device = device(ADDRESS).with_defaults(defaults(0x40));
    let mut other = NodeRig::with_device(device, board.flash.clone(), 0);
    assert_eq!((other.found, other.number(0x1017, 0)), (Found::Complete, 1000));
    assert_eq!(board.power_cycle(), ["740: 00"]);
    assert_eq!(values(&mut board), (200, 1000), "as long as the other stores nothing");
    let mut other = NodeRig::with_device(device, board.flash.clone(), 0);
    other.download(0x1017, 0, &[1, 0]).unwrap();
    other.save(1).unwrap();
    board.power_cycle();
    assert_eq!(values(&mut board), (100, 1));
}

#[test]
fn the_error_behaviour_is_stored_with_the_parameters_of_communication() {
    let mut board = board();
    for (sub_index, expected) in [(3, 0), (2, 1), (1, 1)] {
        board.download(0x1029, 1, &[1]).unwrap();
        board.save(sub_index).unwrap();
        board.nmt("82 40");
        assert_eq!(board.number(0x1029, 1), expected, "1010h sub {sub_index}");
        board.power_cycle();
        assert_eq!(board.number(0x1029, 1), expected, "1010h sub {sub_index}");
    }
    board.download(0x1029, 1, &[2]).unwrap();
    board.nmt("82 40");
    assert_eq!(board.number(0x1029, 1), 1, "the stored one");
    for (sub_index, expected) in [(3, 1), (2, 0)] {
        board.load(sub_index).unwrap();
        board.power_cycle();
        assert_eq!(board.number(0x1029, 1), expected, "1011h sub {sub_index}");
    }
}

#[test]
fn the_capacity_is_the_sum_of_the_longest_values() {
    let lens = [2, 1, 4, 8, 12, 1];
    let sum: usize = lens.iter().map(|len| HEADER + len).sum();
    let of_heartbeat = HEADER + 2;
    let of_error_behaviour = HEADER + 1;
    let of_emergency = HEADER + 4 + HEADER + 2;
    let of_verification = 2 * (HEADER + 4);
    let of_every_node = of_heartbeat + of_error_behaviour + of_emergency + of_verification;
    assert_eq!(canopen_node::Node::<Pump>::STORED_LEN, sum + of_every_node);
    assert_eq!(canopen_node::Node::<Volatile>::STORED_LEN, of_every_node);
    assert_eq!(<canopen_node::Node>::STORED_LEN, of_every_node);
    let mut board = board();
    board.node.application_mut().label = Text::from_bytes(b"twelve bytes").unwrap();
    board.save(1).unwrap();
    assert_eq!(board.stored_parameters().len(), sum + of_heartbeat);
}

#[test]
fn the_parameters_are_packed_as_documented() {
    let mut board = board_with(&BoardFlash::blank(0), Small::new());
    board.node.application_mut().enabled = true;
    board.save(3).unwrap();
    assert_eq!(board.stored_parameters(), [0x01, 0x60, 0, 0x01, 1, 0, 1]);
    let unpacked: Vec<_> = parameters::unpack(board.stored_parameters()).collect();
    assert_eq!((unpacked.len(), unpacked[0].index, unpacked[0].value), (1, 0x6001, &[1][..]));
    let content = board.flash.content();
    let crc = 0xFD96_E654_u32; // Checked with Python's zlib.
    // The places 2 and 3, of 40 bytes, which begin with a word.
    assert_eq!(content[84..88], 411_u32.to_le_bytes(), "the sequence");
    assert_eq!(content[88..95], [0x01, 0x60, 0, 0x01, 1, 0, 1]);
    assert_eq!(content[95..112], [0xFF; 17]);
    assert_eq!(&content[112..116], b"\0\0SP", "the first part");
    assert_eq!(content[124..128], 412_u32.to_le_bytes());
    assert_eq!(content[134..138], [2, 0, 7, 0], "the first place and the length");
    assert_eq!(content[138..142], crc.to_le_bytes());
    assert_eq!(content[142..148], [0xFF, 0xFF, 0xFF, 0xFF, 2, 0xFF]);
}

objects! {
    /// An application that stores nothing.
    pub struct Volatile, values VolatileValue;

    0x6001 {
        0 "Enabled" enabled: bool = false, rw;
    }
}

impl Application for Volatile {}

#[test]
fn a_save_of_the_part_of_an_application_that_stores_nothing_changes_nothing() {
    let mut board = board_with(&BoardFlash::blank(0), Volatile::new());
    board.download(0x1017, 0, &[1, 0]).unwrap();
    assert_eq!(board.save(3), Ok(()));
    board.power_cycle();
    assert_eq!(board.number(0x1017, 0), 500);
    board.download(0x1017, 0, &[1, 0]).unwrap();
    assert_eq!(board.save(2), Ok(()));
    board.power_cycle();
    assert_eq!(board.number(0x1017, 0), 1);
}
