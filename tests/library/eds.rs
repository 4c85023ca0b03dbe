//! The electronic data sheet (CiA 306) that the tables give: the committed file, the form, and each kind of value.

use canopen_node::{
    Application, BitRates, Device, Node,
    application::{OctetString, Text},
};
use firmware::{
    application::Application as Firmware,
    device::{self, DEVICE},
};
use testkit::{
    eds::{DataSheet, Product, Sections, parse},
    node_rig::{self, ADDRESS},
    random::Random,
};

use crate::{
    application::Objects,
    process_data::{Machine, set, write},
};

const COMMITTED: &str = include_str!("../../eds/lss-slave.eds");
const PAGE: &str = include_str!("../../docs/object-dictionary.md");

fn product() -> Product<'static> {
    Product {
        file_name: "lss-slave.eds",
        vendor_name: device::VENDOR_NAME,
        description: device::DESCRIPTION,
        device: DEVICE,
    }
}

/// The data sheet of the firmware.
fn firmware() -> DataSheet<'static> {
    let product = product();
    DataSheet::new(product, <Node<Firmware>>::entries(&product.device), &Firmware::new())
}

/// The data sheet of a node of the test board with this application.
pub fn sheet_of<A: Application>(application: &A) -> String {
    let product = Product { device: node_rig::device(ADDRESS), ..product() };
    DataSheet::new(product, <Node<A>>::entries(&product.device), application).eds()
}

/// The data sheet of a node with one value of each kind.
fn kinds() -> String {
    let mut objects = Objects::new();
    objects.octets = OctetString::from_bytes(&[0x00, 0xAB]).unwrap();
    sheet_of(&objects)
}

/// The keys of a section as one line, sorted.
fn section(sections: &Sections, name: &str) -> String {
    let text: Vec<_> = sections[name].iter().map(|(key, value)| format!("{key}={value}")).collect();
    text.join(" ")
}

#[test]
fn the_committed_files_are_what_the_tables_give() {
    let outdated = "run `cargo xtask eds`";
    assert!(firmware().eds() == COMMITTED, "eds/lss-slave.eds: {outdated}");
    assert!(firmware().page() == PAGE, "docs/object-dictionary.md: {outdated}");
}

#[test]
fn every_object_is_in_the_list_of_its_range() {
    let sections = parse(&kinds());
    assert_eq!(
        section(&sections, "MandatoryObjects"),
        "1=0x1000 2=0x1001 3=0x1018 SupportedObjects=3"
    );
    assert_eq!(
        section(&sections, "ManufacturerObjects"),
        "1=0x2000 2=0x2001 3=0x2100 4=0x2101 5=0x2102 6=0x2103 7=0x2104 8=0x2201 9=0x5FFF \
         SupportedObjects=9"
    );
    let optional = &sections["OptionalObjects"];
    assert_eq!((&*optional["1"], &*optional["11"]), ("0x1003", "0x1029"));
    assert_eq!((&*optional["12"], &*optional["18"]), ("0x1200", "0x9FFF"));
    assert_eq!(optional.len(), 1 + 18);
}

#[test]
fn every_value_has_one_section_and_no_section_is_left_over() {
    let sections = parse(&kinds());
    let is_object = |name: &&String| u16::from_str_radix(&name[..4], 16).is_ok();
    let objects = sections.keys().filter(is_object).count();
    assert_eq!(sections.len() - objects, 7, "FileInfo to ManufacturerObjects");
    let all: Vec<_> = <Node<Objects>>::entries(&product().device).collect();
    let with_sub_indices = all.iter().filter(|(_, description)| description.object.is_some());
    assert_eq!(objects, all.len() + with_sub_indices.count());
}

#[test]
fn a_dummy_is_in_use_if_an_rpdo_takes_it_with_its_number_of_bits() {
    const BITS: [u32; 7] = [1, 8, 16, 32, 8, 16, 32];
    let sheet =
        DataSheet::new(product(), Node::<Machine>::entries(&product().device), &Machine::new());
    let sections = parse(&sheet.eds());
    let mut board = node_rig::NodeRig::running(Machine::new());
    set(&mut board, 0x1400, 1, 0x8000_0240, 4);
    set(&mut board, 0x1600, 0, 0, 1);
    for (data_type, bits) in (1..).zip(BITS) {
        let is_taken = write(&mut board, 0x1600, 1, data_type << 16 | bits, 4).is_ok();
        let dummy = &*sections["DummyUsage"][&format!("Dummy{data_type:04}")];
        assert_eq!(dummy, if is_taken { "1" } else { "0" }, "{data_type}");
        assert_eq!(is_taken, bits != 1, "{data_type}");
    }
    let without_rpdos = parse(&kinds());
    assert!(without_rpdos["DummyUsage"].values().all(|value| value == "0"));
}

#[test]
fn the_objects_of_pdos_have_their_names_and_limits() {
    let sections = parse(&sheet_of(&Machine::new()));
    for (object, name, highest) in [
        ("1005", "COB-ID SYNC", ""),
        ("1400", "RPDO communication parameter 1", ""),
        ("1400sub0", "Highest sub-index supported", ""),
        ("1401sub1", "COB-ID used by RPDO", ""),
        ("1400sub2", "Transmission type", ""),
        ("1400sub5", "Event timer", ""),
        ("1600sub0", "Number of mapped objects", "8"),
        ("1600sub1", "Application object", ""),
        ("1801", "TPDO communication parameter 2", ""),
        ("1800sub0", "Highest sub-index supported", ""),
        ("1800sub1", "COB-ID used by TPDO", ""),
        ("1800sub2", "Transmission type", ""),
        ("1800sub3", "Inhibit time", ""),
        ("1800sub5", "Event timer", ""),
        ("1800sub6", "SYNC start value", "240"),
        ("1A00sub0", "Number of mapped objects", "8"),
        ("1A00sub8", "Application object", ""),
    ] {
        let limit = sections[object].get("HighLimit").map_or("", |limit| limit);
        assert_eq!((&*sections[object]["ParameterName"], limit), (name, highest), "{object}");
    }
}

/// Sections, each with its keys in their order.
const KINDS: &str = "
1018sub1: AccessType=const DataType=0x0007 DefaultValue=0x11223344 ObjectType=0x7 PDOMapping=0 ParameterName=Vendor-ID
2100: ObjectType=0x9 ParameterName=Signed numbers SubNumber=5
2100sub0: AccessType=const DataType=0x0005 DefaultValue=11 ObjectType=0x7 PDOMapping=0 ParameterName=Highest sub-index supported
2100sub1: AccessType=rw DataType=0x0002 DefaultValue=-8 HighLimit=10 LowLimit=-10 ObjectType=0x7 PDOMapping=0 ParameterName=8 bits
2100sub2: AccessType=rw DataType=0x0003 DefaultValue=-300 ObjectType=0x7 PDOMapping=1 ParameterName=16 bits
2100subB: AccessType=rw DataType=0x0015 DefaultValue=-9223372036854775808 ObjectType=0x7 PDOMapping=1 ParameterName=64 bits
2101sub3: AccessType=ro DataType=0x0007 ObjectType=0x7 PDOMapping=1 ParameterName=32 bits
2102sub1: AccessType=rw DataType=0x0010 DefaultValue=-2 HighLimit=8388606 LowLimit=-8388608 ObjectType=0x7 PDOMapping=1 ParameterName=24 bits
2103sub1: AccessType=rwr DataType=0x0016 DefaultValue=1193046 ObjectType=0x7 PDOMapping=1 ParameterName=24 bits
2103sub4: AccessType=rww DataType=0x001A DefaultValue=72057594037927935 HighLimit=72057594037927935 LowLimit=1 ObjectType=0x7 PDOMapping=1 ParameterName=56 bits
2104: ObjectType=0x8 ParameterName=Percentages SubNumber=3
5FFF: AccessType=rw DataType=0x001B DefaultValue=18446744073709551615 HighLimit=18446744073709551615 LowLimit=1 ObjectType=0x7 PDOMapping=0 ParameterName=Large number
6000: AccessType=rw DataType=0x0008 ObjectType=0x7 PDOMapping=1 ParameterName=Real number
6001: AccessType=wo DataType=0x0006 ObjectType=0x7 PDOMapping=0 ParameterName=Command
6003: AccessType=const DataType=0x0009 DefaultValue=A | B ObjectType=0x7 PDOMapping=0 ParameterName=Label
6004: AccessType=rw DataType=0x000A DefaultValue=00AB ObjectType=0x7 PDOMapping=0 ParameterName=Octets
9FFF: AccessType=ro DataType=0x000F ObjectType=0x2 ParameterName=Domain
";

#[test]
fn each_kind_of_value_is_described_as_cia_306_says() {
    let sections = parse(&kinds());
    for line in KINDS.trim().lines() {
        let (name, expected) = line.split_once(": ").expect("a section and its keys");
        assert_eq!(section(&sections, name), expected, "[{name}]");
    }
    assert_eq!(sections["2001"]["DefaultValue"], "1");
    assert_eq!(sections["6002"]["DefaultValue"], "");
}

#[test]
fn random_values_are_in_the_file_as_they_are() {
    let mut random = Random::from_environment();
    for _ in 0..100 {
        let text: Vec<_> =
            (0..random.within(0..13)).map(|_| random.within(0x20..0x7F) as u8).collect();
        let octets = random.bytes::<3>();
        let mut objects = Objects::new();
        objects.i16 = random.u32() as i16;
        objects.i64 = random.u64() as i64;
        objects.u64 = random.u64();
        objects.text = Text::from_bytes(&text).unwrap();
        objects.octets = OctetString::from_bytes(&octets).unwrap();
        let sections = parse(&sheet_of(&objects));
        let octets: String = octets.iter().map(|octet| format!("{octet:02X}")).collect();
        for (name, value) in [
            ("2100sub2", objects.i16.to_string()),
            ("2100subB", objects.i64.to_string()),
            ("5FFF", objects.u64.to_string()),
            ("6002", String::from_utf8(text).unwrap()),
            ("6004", octets),
        ] {
            assert_eq!(sections[name]["DefaultValue"], value, "[{name}]");
        }
    }
}

#[test]
fn objects_of_the_standard_are_arrays_and_records_as_it_says() {
    let sections = parse(COMMITTED);
    for (record, names) in
        [("0x9", &["1018", "2000"][..]), ("0x8", &["1003", "1010", "1011", "1029"])]
    {
        for name in names {
            assert_eq!(sections[*name]["ObjectType"], record, "[{name}]");
        }
    }
}

#[test]
fn tools_leave_out_objects_whose_write_triggers_an_action() {
    let mut sections = parse(COMMITTED);
    sections.retain(|_, section| section.contains_key("ObjFlags"));
    assert!(sections.values().all(|section| section["ObjFlags"] == "1"));
    let found: Vec<_> = sections.keys().collect();
    let stores =
        ["1010sub1", "1010sub2", "1010sub3", "1011sub1", "1011sub2", "1011sub3"].into_iter();
    assert_eq!(found, ["1003sub0"].into_iter().chain(stores).collect::<Vec<_>>());
}

#[test]
fn the_device_is_the_one_that_the_product_describes() {
    // 800 kbit/s cannot be made of 42 MHz.
    let device = Device::new(ADDRESS, BitRates::possible(42_000_000)).with_name("Valve");
    let product =
        Product { file_name: "valve.eds", vendor_name: "Example", description: "A valve", device };
    let sheet = DataSheet::new(product, <Node<Firmware>>::entries(&device), &Firmware::new());
    let sections = parse(&sheet.eds());
    for (key, value) in [
        ("VendorName", "Example"),
        ("VendorNumber", "0x11223344"),
        ("ProductName", "Valve"),
        ("ProductNumber", "0x55667788"),
        ("RevisionNumber", "0x00010203"),
        ("BaudRate_1000", "1"),
        ("BaudRate_800", "0"),
        ("BaudRate_10", "1"),
        ("LSS_Supported", "1"),
        ("SimpleBootUpMaster", "0"),
        ("SimpleBootUpSlave", "1"),
    ] {
        assert_eq!(sections["DeviceInfo"][key], value, "{key}");
    }
    assert_eq!(sections["FileInfo"]["FileName"], "valve.eds");
    assert_eq!(sections["FileInfo"]["Description"], "A valve");
    assert_eq!(sections["1008"]["DefaultValue"], "Valve");
    assert_eq!(sections["1018sub2"]["DefaultValue"], "0x55667788");
}

#[test]
fn the_file_keeps_to_the_form_of_cia_306() {
    for eds in [COMMITTED, &kinds()] {
        let sections = parse(eds);
        assert_eq!(sections["FileInfo"]["EDSVersion"], "4.0");
        for key in ["CreationDate", "ModificationDate"] {
            let digit = |c: char| if c.is_ascii_digit() { '9' } else { c };
            let form: String = sections["FileInfo"][key].chars().map(digit).collect();
            assert_eq!(form, "99-99-9999", "{key}: mm-dd-yyyy");
        }
        let comments = &sections["Comments"];
        assert_eq!(comments.len(), comments["Lines"].parse::<usize>().unwrap() + 1);
        assert!(eds.lines().all(|line| line == line.trim()));
        assert!(eds.ends_with('\n') && !eds.ends_with("\n\n") && !eds.contains("\n\n\n"));
    }
}

#[test]
#[should_panic = "not possible in an EDS: ProductName=Gerät"]
fn a_name_that_is_not_ascii_is_refused() {
    let device = DEVICE.with_name("Gerät");
    let product = Product { device, ..product() };
    DataSheet::new(product, <Node<Firmware>>::entries(&device), &Firmware::new()).eds();
}
