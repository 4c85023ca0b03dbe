//! The EDS (CiA 306) compared with the object dictionary, the node and the identity in the firmware's device.rs.

use std::collections::{BTreeMap, BTreeSet};

use lss_slave::{
    BitRate, BitRates, Device,
    lss::Address,
    object_dictionary::{Access, DataType, Entry, Object, TABLE},
};
use testkit::{
    flash::BoardFlash,
    node_rig::{NodeRig, defaults},
};

const EDS: &str = include_str!("../../eds/lss-slave.eds");
const DEVICE_RS: &str = include_str!("../../src/device.rs");

type Section = BTreeMap<&'static str, &'static str>;

/// The sections of the EDS by name. Neither a section nor a key may occur twice.
fn sections() -> BTreeMap<&'static str, Section> {
    let mut sections = BTreeMap::new();
    let mut name = None;
    for line in EDS.lines().filter(|line| !line.is_empty()) {
        if let Some(section) = line.strip_prefix('[').and_then(|line| line.strip_suffix(']')) {
            assert!(sections.insert(section, Section::new()).is_none(), "[{section}] twice");
            name = Some(section);
        } else {
            let (key, value) = line.split_once('=').expect("key=value");
            let section = sections.get_mut(name.expect("a section")).unwrap();
            assert!(section.insert(key, value).is_none(), "{key} twice in {name:?}");
        }
    }
    sections
}

/// Parses a number in the notation of EDS or Rust.
fn number(text: &str) -> u32 {
    let text = text.replace('_', "");
    match text.strip_prefix("0x") {
        Some(hex) => u32::from_str_radix(hex, 16),
        None => text.parse(),
    }
    .unwrap_or_else(|_| panic!("{text} is a number"))
}

/// The text that follows `before` in device.rs, up to `end`.
fn in_device_rs(before: &str, end: char) -> &'static str {
    let (_, rest) = DEVICE_RS.split_once(before).unwrap_or_else(|| panic!("{before} is there"));
    rest.split(end).next().unwrap()
}

fn number_in_device_rs(name: &str) -> u32 {
    number(in_device_rs(&format!("pub const {name}: u32 = "), ';'))
}

fn text_in_device_rs(name: &str) -> &'static str {
    match in_device_rs(&format!("pub const {name}: &str = "), ';') {
        "env!(\"CARGO_PKG_VERSION\")" => env!("CARGO_PKG_VERSION"),
        literal => literal.trim_matches('"'),
    }
}

/// The rates that the clock of the CAN controller can produce, which device.rs offers. An EDS has no key for automatic
/// detection.
fn bit_rates() -> BitRates {
    assert!(DEVICE_RS.contains("pub const BIT_RATES: BitRates = BitRates::possible(APB1_HZ)"));
    let divisor = in_device_rs("pub const APB1_HZ: u32 = SYSCLK_HZ / ", ';');
    BitRates::possible(number_in_device_rs("SYSCLK_HZ") / number(divisor))
}

/// A board with the identity and the defaults of the firmware, and node-ID 40h.
fn board_of_device_rs() -> NodeRig {
    let heartbeat_ms = number(in_device_rs("with_heartbeat_ms(", ')')) as u16;
    let address = Address {
        vendor_id: number_in_device_rs("VENDOR_ID"),
        product_code: number_in_device_rs("PRODUCT_CODE"),
        revision_number: number_in_device_rs("REVISION_NUMBER"),
        serial_number: 0,
    };
    let device = Device::new(address, bit_rates())
        .with_defaults(defaults(0x40).with_heartbeat_ms(heartbeat_ms))
        .with_name(text_in_device_rs("NAME"))
        .with_versions(text_in_device_rs("HARDWARE_VERSION"), text_in_device_rs("SOFTWARE_VERSION"))
        .with_rescue(true);
    NodeRig::with_device(device, BoardFlash::blank(0), 0)
}

/// The name of the section that describes `entry`.
fn section_of(entry: &Entry) -> String {
    let has_sub_indices = TABLE.iter().filter(|other| other.index == entry.index).count() > 1;
    match has_sub_indices {
        true => format!("{:04X}sub{:X}", entry.index, entry.sub_index),
        false => format!("{:04X}", entry.index),
    }
}

/// The indices in the list `name`.
fn list(name: &str) -> Vec<u32> {
    let sections = sections();
    let list = &sections[name];
    let len = number(list["SupportedObjects"]);
    assert_eq!(list.len(), len as usize + 1, "[{name}] gives the right number");
    (1..=len).map(|n| number(list[n.to_string().as_str()])).collect()
}

#[test]
fn the_lists_name_every_object_of_the_dictionary_and_no_other() {
    let indices: BTreeSet<u32> = TABLE.iter().map(|entry| entry.index.into()).collect();
    let mandatory = [0x1000, 0x1001, 0x1018];
    assert_eq!(list("MandatoryObjects"), mandatory);
    let is_optional = |index: &u32| {
        let is_of_the_manufacturer = (0x2000..0x6000).contains(index);
        !mandatory.contains(index) && !is_of_the_manufacturer
    };
    let optional: Vec<u32> = indices.iter().copied().filter(is_optional).collect();
    assert_eq!(list("OptionalObjects"), optional);
    let manufacturer: Vec<u32> = indices.range(0x2000..0x6000).copied().collect();
    assert_eq!(list("ManufacturerObjects"), manufacturer);
}

#[test]
fn each_object_has_a_section_with_its_data_type_and_access() {
    let sections = sections();
    for entry in TABLE {
        let name = section_of(entry);
        let section = &sections[name.as_str()];
        assert_eq!(number(section["ObjectType"]), 7, "[{name}] VAR");
        let data_type = match entry.data_type {
            DataType::Unsigned8 => "0x0005",
            DataType::Unsigned16 => "0x0006",
            DataType::Unsigned32 => "0x0007",
            DataType::VisibleString => "0x0009",
            other => panic!("{other:?}"),
        };
        assert_eq!(section["DataType"], data_type, "[{name}]");
        assert_eq!(number(data_type), entry.data_type as u32);
        let access = match entry.access {
            Access::Const => "const",
            Access::ReadOnly => "ro",
            Access::ReadWrite => "rw",
            Access::WriteOnly => "wo",
        };
        assert_eq!(section["AccessType"], access, "[{name}]");
        assert_eq!(section["PDOMapping"], "0", "[{name}]");
        assert!(!section["ParameterName"].is_empty(), "[{name}]");
    }
}

#[test]
fn an_object_with_sub_indices_gives_their_number_and_array_or_record() {
    let sections = sections();
    for entry in TABLE.iter().filter(|entry| section_of(entry).ends_with("sub0")) {
        let name = format!("{:04X}", entry.index);
        let section = &sections[name.as_str()];
        let subs: Vec<_> = TABLE.iter().filter(|other| other.index == entry.index).collect();
        assert_eq!(number(section["SubNumber"]) as usize, subs.len(), "[{name}]");
        let record = 9;
        let array = 8;
        let expected = if [0x1018, 0x2000].contains(&entry.index) { record } else { array };
        assert_eq!(number(section["ObjectType"]), expected, "[{name}]");
        assert!(!section["ParameterName"].is_empty(), "[{name}]");
    }
}

#[test]
fn no_section_is_left_over() {
    let mut expected: BTreeSet<String> = [
        "FileInfo",
        "DeviceInfo",
        "DummyUsage",
        "Comments",
        "MandatoryObjects",
        "OptionalObjects",
        "ManufacturerObjects",
    ]
    .map(String::from)
    .into();
    expected.extend(TABLE.iter().map(|entry| format!("{:04X}", entry.index)));
    expected.extend(TABLE.iter().map(section_of));
    let found: BTreeSet<String> = sections().into_keys().map(String::from).collect();
    assert_eq!(found, expected);
}

#[test]
fn each_default_value_is_the_answer_of_a_new_device_by_sdo() {
    let sections = sections();
    let mut board = board_of_device_rs();
    for entry in TABLE {
        let name = section_of(entry);
        let Some(default) = sections[name.as_str()].get("DefaultValue") else {
            let is_of_the_past = [0x1003, 0x2000].contains(&entry.index) && entry.sub_index > 0;
            assert!(name == "1018sub4" || is_of_the_past, "[{name}] has no default");
            continue;
        };
        let value = board.upload(entry.index, entry.sub_index).unwrap();
        if entry.data_type == DataType::VisibleString {
            let value = String::from_utf8_lossy(&value);
            assert_eq!(value, *default, "device.rs, then eds/lss-slave.eds [{name}] DefaultValue");
            continue;
        }
        let expected = match default.strip_prefix("$NODEID+") {
            Some(offset) => 0x40 + number(offset),
            None => number(default),
        };
        let value = board.number(entry.index, entry.sub_index);
        assert_eq!(value, expected, "device.rs, then eds/lss-slave.eds [{name}] DefaultValue");
    }
}

#[test]
fn tools_leave_out_objects_whose_write_triggers_an_action() {
    const REFUSE_WRITE_ON_DOWNLOAD: &str = "1";
    let sections = sections();
    for entry in TABLE {
        let name = section_of(entry);
        let acts = matches!(
            entry.object,
            Object::StoreParameters | Object::RestoreDefaultParameters | Object::NumberOfErrors
        );
        let flags = sections[name.as_str()].get("ObjFlags").copied();
        assert_eq!(flags, acts.then_some(REFUSE_WRITE_ON_DOWNLOAD), "[{name}]");
    }
}

#[test]
fn the_identity_is_the_one_in_device_rs() {
    let info = &sections()["DeviceInfo"];
    for (key, name) in [
        ("VendorNumber", "VENDOR_ID"),
        ("ProductNumber", "PRODUCT_CODE"),
        ("RevisionNumber", "REVISION_NUMBER"),
    ] {
        let (eds, device) = (number(info[key]), number_in_device_rs(name));
        assert_eq!(eds, device, "eds/lss-slave.eds {key}, then device.rs {name}");
    }
    let (eds, device) = (info["ProductName"], text_in_device_rs("NAME"));
    assert_eq!(eds, device, "eds/lss-slave.eds ProductName, then device.rs NAME");
}

#[test]
fn the_bit_rates_are_those_that_the_clock_can_produce() {
    let info = &sections()["DeviceInfo"];
    let possible = bit_rates();
    let found: Vec<_> = info.keys().filter(|key| key.starts_with("BaudRate_")).collect();
    assert_eq!(found.len(), BitRate::ALL.len());
    for rate in BitRate::ALL {
        let expected = if possible.contains(rate) { "1" } else { "0" };
        let key = format!("BaudRate_{}", rate.kbit_per_s());
        assert_eq!(info[key.as_str()], expected, "{key}");
    }
}

#[test]
fn the_device_is_an_lss_slave_that_boots_up_by_itself_and_has_no_pdo() {
    let info = &sections()["DeviceInfo"];
    for (key, value) in [
        ("LSS_Supported", "1"),
        ("SimpleBootUpMaster", "0"),
        ("SimpleBootUpSlave", "1"),
        ("NrOfRXPDO", "0"),
        ("NrOfTXPDO", "0"),
        ("Granularity", "0"),
    ] {
        assert_eq!(info[key], value, "{key}");
    }
}

#[test]
fn the_file_knows_its_name_and_keeps_to_the_form_of_cia_306() {
    let sections = sections();
    assert_eq!(sections["FileInfo"]["FileName"], "lss-slave.eds");
    assert_eq!(sections["FileInfo"]["EDSVersion"], "4.0");
    for key in ["CreationDate", "ModificationDate"] {
        let form: String = sections["FileInfo"][key]
            .chars()
            .map(|c| if c.is_ascii_digit() { '9' } else { c })
            .collect();
        assert_eq!(form, "99-99-9999", "{key}: mm-dd-yyyy");
    }
    let comments = &sections["Comments"];
    assert_eq!(comments.len(), number(comments["Lines"]) as usize + 1);
    assert!(EDS.is_ascii());
    assert!(EDS.lines().all(|line| line.len() <= 255 && line == line.trim()));
}
