//! Arrays and limits from constants in the objects of a product, by SDO, PDO, 1010h and in the EDS.

use canopen_node::{
    Application, Frame,
    application::{Dictionary, Unsigned24},
    objects,
    pdo::{Rpdo, Tpdo},
    sdo::Abort,
    settings::parameters::HEADER,
};
use testkit::{
    eds::parse,
    flash::BoardFlash,
    frames::bytes,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::Client,
};

use crate::eds::sheet_of;

const LOWEST_GAIN: f32 = 0.5;
const HIGHEST_GAIN: f32 = 2.0;
/// A limit below zero, to be used beside literals.
const COLDEST: i16 = -400;

objects! {
    /// The objects of a scale with four cells.
    pub struct Scale, values ScaleValue;

    0x2100 "Gains" {
        1..=4 "Gain" gains: [f32; 4] = [1.0, 1.0, 1.0, 1.5], rw in LOWEST_GAIN..=HIGHEST_GAIN, stored;
        5 "Unit" unit: u8 = 3, rw in 0..=u8::MAX / 2;
    }
    0x2101 {
        0 "Offset" offset: i16 = 0, rw in COLDEST..=1250, stored;
    }
    0x2102 "Counts" {
        2..=3 "Count" counts: [Unsigned24; 2] = [10, 20], rw in 10..=(1 << 24) - 1, mappable;
        7 "Last" last: u8 = 9, ro;
    }
}

impl Application for Scale {
    const TPDOS: &'static [Tpdo] = &[Tpdo::new(&[(0x2102, 3), (0x2102, 2)])];
    const RPDOS: &'static [Rpdo] = &[Rpdo::new(&[(0x2102, 2), (0x2102, 3)])];

    fn accept(&mut self, value: &ScaleValue) -> Result<(), Abort> {
        match *value {
            ScaleValue::Gains((2, gain)) if gain != 1.0 => Err(Abort::DeviceState),
            _ => Ok(()),
        }
    }
}

/// A board with node-ID 40h, one TPDO and one RPDO.
fn board(flash: BoardFlash) -> NodeRig<Scale> {
    NodeRig::with_application(device(ADDRESS).with_defaults(defaults(0x40)), flash, 0, Scale::new())
}

const TOO_LOW: Result<(), u32> = Err(0x0609_0032);
const TOO_HIGH: Result<(), u32> = Err(0x0609_0031);

#[test]
fn each_value_of_an_array_has_its_sub_index() {
    let mut board = board(BoardFlash::blank(0));
    assert_eq!(board.sdo("40 00 21 00"), ["5C0: 4F 00 21 00 05 00 00 00"]);
    assert_eq!(board.sdo("40 00 21 01"), ["5C0: 43 00 21 01 00 00 80 3F"]);
    assert_eq!(board.sdo("40 00 21 04"), ["5C0: 43 00 21 04 00 00 C0 3F"]);
    assert_eq!(board.sdo("40 00 21 05"), ["5C0: 4F 00 21 05 03 00 00 00"]);
    assert_eq!(board.sdo("23 00 21 04 00 00 00 40"), ["5C0: 60 00 21 04 00 00 00 00"]);
    assert_eq!(board.node.application().gains, [1.0, 1.0, 1.0, 2.0]);
    assert_eq!(board.number(0x2102, 0), 7);
    assert_eq!(board.upload(0x2102, 1), Err(0x0609_0011), "the array begins at 2");
    assert_eq!(board.upload(0x2102, 3).unwrap(), [20, 0, 0]);
    assert_eq!(board.upload(0x2102, 4), Err(0x0609_0011), "the array ends at 3");
}

#[test]
fn limits_may_be_constants() {
    let mut board = board(BoardFlash::blank(0));
    for sub_index in [1, 4] {
        let mut write = |gain: f32| board.download(0x2100, sub_index, &gain.to_le_bytes());
        assert_eq!((write(0.49), write(2.01), write(2.0)), (TOO_LOW, TOO_HIGH, Ok(())));
        assert_eq!(write(f32::NAN), TOO_HIGH, "it is not between the limits");
    }
    let mut write = |offset: i16| board.download(0x2101, 0, &offset.to_le_bytes());
    assert_eq!((write(-401), write(1251), write(-400)), (TOO_LOW, TOO_HIGH, Ok(())));
    assert_eq!(board.download(0x2100, 5, &[128]), TOO_HIGH);
    assert_eq!(board.download(0x2102, 3, &[9, 0, 0]), TOO_LOW);
}

#[test]
fn the_application_learns_the_place_of_a_value_in_its_array() {
    let mut board = board(BoardFlash::blank(0));
    assert_eq!(board.download(0x2100, 3, &2.0_f32.to_le_bytes()), Err(0x0800_0022));
    assert_eq!(board.download(0x2100, 2, &2.0_f32.to_le_bytes()), Ok(()));
    assert_eq!(board.node.application().gains, [1.0, 2.0, 1.0, 1.5]);
}

#[test]
fn pdos_carry_the_values_of_an_array() {
    let mut board = board(BoardFlash::blank(0));
    assert_eq!(board.nmt("01 40"), ["1C0: 14 00 00 0A 00 00"]);
    let mut receive = |data| board.receive(&Frame::new(0x240, &bytes(data)).unwrap());
    assert_eq!(receive("0B 00 00 15 00 00"), ["1C0: 15 00 00 0B 00 00"]);
    assert_eq!(receive("09 00 00 16 00 00"), ["1C0: 16 00 00 0B 00 00"], "9 is out of the limits");
    assert_eq!(board.node.application().counts, [11, 22]);
}

#[test]
fn an_array_is_stored_whole() {
    assert_eq!(Scale::STORED_LEN, 4 * (HEADER + 4) + HEADER + 2);
    let mut board = board(BoardFlash::blank(0));
    for (sub_index, gain) in [(1, 0.5_f32), (4, 1.25)] {
        assert_eq!(board.download(0x2100, sub_index, &gain.to_le_bytes()), Ok(()));
    }
    assert_eq!(board.save(1), Ok(()));
    board.power_cycle();
    assert_eq!(board.node.application().gains, [0.5, 1.0, 1.0, 1.25]);
}

#[test]
fn the_data_sheet_numbers_the_names_of_an_array() {
    let sections = parse(&sheet_of(&Scale::new()));
    let of = |section: &str, key: &str| sections[section][key].clone();
    assert_eq!(of("2100", "SubNumber"), "6");
    assert_eq!(of("2100sub0", "DefaultValue"), "5");
    let last = "2100sub4";
    assert_eq!([of("2100sub1", "ParameterName"), of(last, "ParameterName")], ["Gain 1", "Gain 4"]);
    assert_eq!(of(last, "DataType"), "0x0008");
    let of_reals = ["LowLimit", "HighLimit", "DefaultValue"];
    assert!(of_reals.iter().all(|key| !sections[last].contains_key(*key)), "not of REALs");
    assert_eq!(of("2100sub5", "ParameterName"), "Unit");
    assert_eq!([of("2102sub2", "DefaultValue"), of("2102sub3", "DefaultValue")], ["10", "20"]);
    assert_eq!(of("1800", "ParameterName"), "TPDO communication parameter 1");
}
