//! A product's own objects, declared by `objects!`: every type, access, limit and refusal, read and written by SDO.

use canopen_node::{
    Application, Node,
    application::{
        Dictionary, Domain, Integer24, Integer40, Integer48, Integer56, OctetString, Text,
        Unsigned24, Unsigned40, Unsigned48, Unsigned56,
    },
    object_dictionary::{Entry, Number},
    objects,
    sdo::Abort,
};
use testkit::{
    node_rig::{ADDRESS, NodeRig, device},
    sdo::Client,
};

objects! {
    /// One object of each type.
    pub struct Objects, values ObjectValue;

    0x2001 {
        0 "Boolean" boolean: bool = true, rw;
    }
    0x2100 "Signed numbers" {
        1 "8 bits" i8: i8 = -8, rw in -10..=10;
        2 "16 bits" i16: i16 = -300, rw, mappable;
        3 "32 bits" i32: i32 = -32, rw, stored;
        0xB "64 bits" i64: i64 = i64::MIN, rw, mappable, stored;
    }
    0x2101 "Unsigned numbers" {
        1 "8 bits" u8: u8 = 8, rw in 5..=250;
        2 "16 bits" u16: u16 = 16, rw;
        3 "32 bits" u32: u32 = 32, ro, mappable;
    }
    0x2102 "Signed numbers of other lengths" {
        1 "24 bits" i24: Integer24 = -2, rw in -8_388_608..=8_388_606, mappable, stored;
        2 "40 bits" i40: Integer40 = -2, rw, mappable;
        3 "48 bits" i48: Integer48 = -2, rw, mappable;
        4 "56 bits" i56: Integer56 = -2, rw, mappable;
    }
    0x2103 "Unsigned numbers of other lengths" {
        1 "24 bits" u24: Unsigned24 = 0x12_3456, rwr;
        2 "40 bits" u40: Unsigned40 = 40, rw, mappable;
        3 "48 bits" u48: Unsigned48 = 48, rw, mappable;
        4 "56 bits" u56: Unsigned56 = 0xFF_FFFF_FFFF_FFFF, rww in 1..=72_057_594_037_927_935;
    }
    0x2104 "Percentages" {
        1 "First" first: u8 = 50, rw in 0..=100, stored;
        2 "Second" second: u8 = 60, rw;
    }
    0x2201 {
        0 "Long real number" f64: f64 = -2.5, rw;
    }
    0x5FFF {
        0 "Large number" u64: u64 = u64::MAX, rw in 1..=0xFFFF_FFFF_FFFF_FFFF;
    }
    0x6000 {
        0 "Real number" f32: f32 = 0.1, rw in 0.05..=2.5, mappable;
    }
    0x6001 {
        0 "Command" command: u16 = 0, wo;
    }
    0x6002 {
        0 "Text" text: Text<12> = Text::EMPTY, rw;
    }
    0x6003 {
        0 "Label" label: &'static str = "A | B", constant;
    }
    0x6004 {
        0 "Octets" octets: OctetString<3> = OctetString::EMPTY, rw;
    }
    0x9FFF {
        0 "Domain" domain: Domain = Domain, ro;
    }
}

impl Application for Objects {
    fn accept(&mut self, value: &ObjectValue) -> Result<(), Abort> {
        match value {
            ObjectValue::U16(0xDEAD) => Err(Abort::DeviceState),
            ObjectValue::Command(_) if !self.boolean => Err(Abort::Hardware),
            _ => Ok(()),
        }
    }
}

/// A board with node-ID 40h and these objects.
fn board() -> NodeRig<Objects> {
    NodeRig::running(Objects::new())
}

#[test]
fn short_numbers_are_read_and_written_as_typed_values() {
    let mut board = board();
    assert_eq!(board.sdo("40 00 21 01"), ["5C0: 4F 00 21 01 F8 00 00 00"]);
    assert_eq!(board.sdo("40 00 21 02"), ["5C0: 4B 00 21 02 D4 FE 00 00"]);
    assert_eq!(board.sdo("40 00 21 03"), ["5C0: 43 00 21 03 E0 FF FF FF"]);
    assert_eq!(board.sdo("40 00 60 00"), ["5C0: 43 00 60 00 CD CC CC 3D"]);
    assert_eq!(board.sdo("2B 00 21 02 34 12"), ["5C0: 60 00 21 02 00 00 00 00"]);
    assert_eq!(board.node.application().i16, 0x1234);
    board.node.application_mut().i16 = -2;
    assert_eq!(board.sdo("40 00 21 02"), ["5C0: 4B 00 21 02 FE FF 00 00"]);
}

#[test]
fn an_object_with_a_name_has_its_highest_sub_index() {
    let mut board = board();
    assert_eq!(board.number(0x2100, 0), 11);
    assert_eq!(board.number(0x2101, 0), 3);
    assert_eq!(board.upload(0x2100, 4), Err(0x0609_0011), "there is a gap");
    assert_eq!(board.upload(0x2105, 0), Err(0x0602_0000));
    assert_eq!(board.upload(0x2001, 1), Err(0x0609_0011));
}

#[test]
fn a_value_out_of_its_limits_is_refused() {
    let mut board = board();
    for (value, outcome) in
        [(4, Err(0x0609_0032)), (5, Ok(())), (250, Ok(())), (251, Err(0x0609_0031))]
    {
        assert_eq!(board.download(0x2101, 1, &[value]), outcome, "{value}");
    }
    assert_eq!(board.node.application().u8, 250);
    assert_eq!(board.download(0x2100, 1, &[0xF5]), Err(0x0609_0032), "-11");
    assert_eq!(board.download(0x6000, 0, &2.6_f32.to_le_bytes()), Err(0x0609_0031));
    assert_eq!(board.download(0x2001, 0, &[2]), Err(0x0609_0030), "a boolean is 0 or 1");
}

#[test]
fn a_real_number_with_limits_must_be_a_number() {
    let mut board = board();
    assert_eq!(board.download(0x6000, 0, &f32::NAN.to_le_bytes()), Err(0x0609_0031));
    assert_eq!(board.download(0x2201, 0, &f64::NAN.to_le_bytes()), Ok(()), "without limits");
}

#[test]
fn integers_of_24_to_56_bits_have_their_length_and_their_sign() {
    let mut board = board();
    for (sub_index, len) in [(1, 3), (2, 5), (3, 6), (4, 7)] {
        let minus_two = [&[0xFE][..], &vec![0xFF; len - 1]].concat();
        assert_eq!(board.upload(0x2102, sub_index), Ok(minus_two));
        let lowest = [vec![0; len - 1], vec![0x80]].concat();
        let highest = [vec![0xFF; len - 1], vec![0x7F]].concat();
        for value in [lowest, highest].iter().take(if len == 3 { 1 } else { 2 }) {
            assert_eq!(board.download(0x2102, sub_index, value), Ok(()));
            assert_eq!(board.upload(0x2102, sub_index).as_ref(), Ok(value));
        }
        let all = vec![0xFF; len];
        assert_eq!(board.download(0x2103, sub_index, &all), Ok(()));
        assert_eq!(board.upload(0x2103, sub_index), Ok(all));
        let (long, short) = (vec![0; len + 1], vec![0; len - 1]);
        for index in [0x2102, 0x2103] {
            assert_eq!(board.download(index, sub_index, &long), Err(0x0607_0012), "{index:X}");
            assert_eq!(board.download(index, sub_index, &short), Err(0x0607_0013), "{index:X}");
        }
    }
    let application = board.node.application();
    assert_eq!((application.i24, application.i40), (-0x80_0000, 0x7F_FFFF_FFFF));
    assert_eq!((application.i48, application.i56), (0x7FFF_FFFF_FFFF, 0x7F_FFFF_FFFF_FFFF));
    assert_eq!((application.u24, application.u40), (0xFF_FFFF, 0xFF_FFFF_FFFF));
    assert_eq!((application.u48, application.u56), (0xFFFF_FFFF_FFFF, 0xFF_FFFF_FFFF_FFFF));
    assert_eq!(board.download(0x2102, 1, &[0xFF, 0xFF, 0x7F]), Err(0x0609_0031));
    assert_eq!(board.download(0x2103, 4, &[0; 7]), Err(0x0609_0032));
}

#[test]
fn a_field_out_of_its_range_is_read_as_the_nearest_number() {
    let mut board = board();
    for (i24, expected) in [(i32::MIN, [0, 0, 0x80]), (i32::MAX, [0xFF, 0xFF, 0x7F])] {
        board.node.application_mut().i24 = i24;
        assert_eq!(board.upload(0x2102, 1), Ok(expected.to_vec()));
    }
    board.node.application_mut().u40 = 1 << 40;
    assert_eq!(board.upload(0x2103, 2), Ok(vec![0xFF; 5]));
}

#[test]
fn the_application_refuses_a_value_by_its_own_reason() {
    let mut board = board();
    assert_eq!(board.download(0x2101, 2, &[0xAD, 0xDE]), Err(0x0800_0022));
    assert_eq!(board.node.application().u16, 16, "the old value stays");
    board.node.application_mut().boolean = false;
    assert_eq!(board.download(0x6001, 0, &[1, 0]), Err(0x0606_0000));
}

#[test]
fn each_object_has_a_description() {
    let of = |index, sub_index| {
        let is_it = |(entry, _): &(Entry, _)| (entry.index, entry.sub_index) == (index, sub_index);
        <Node<Objects>>::entries(&device(ADDRESS)).find(is_it).unwrap().1
    };
    assert_eq!(Objects::descriptions().count(), Objects::OBJECTS.len());
    assert_eq!(of(0x1029, 1).name.to_string(), "Communication error");
    assert_eq!(of(0x2001, 0).object, None);
    assert_eq!(of(0x2100, 0).object, Some("Signed numbers".into()));
    assert_eq!(of(0x2100, 1).name.to_string(), "8 bits");
    assert_eq!(of(0x2100, 1).limits, Some((Number::Integer(-10), Number::Integer(10))));
    assert_eq!(of(0x2101, 3).limits, None);
    assert_eq!(of(0x6000, 0).limits, Some((Number::Real32(0.05), Number::Real32(2.5))));
}
