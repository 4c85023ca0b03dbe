//! EDS checker: the data sheet itself, without the device (CiA 306).

use crate::{
    Bench, Case, Group, Step,
    eds::{Access, Eds, Entry},
};

pub const GROUP: Group = Group {
    name: "EDS checker",
    prepare: |_| Ok(()),
    cases: &[Case::new("The data sheet is complete and consistent", check).with_remark(
        "The tool runs CANchkEDS of Vector, which is not public; the rules are those of CiA 306. \
         A mapped value with access rw is a warning there, since its direction is unknown, and a \
         note here.",
    )],
};

fn check(bench: &mut Bench) -> Step {
    let eds = bench.eds;
    let mut faults: Vec<String> = eds.faults.iter().map(ToString::to_string).collect();
    lists(eds, &mut faults);
    for index in eds.indices() {
        object(eds, index, &mut faults);
    }
    for entry in eds.entries() {
        value(entry, &mut faults);
        default_mapping(eds, entry, &mut faults);
        if entry.is_mappable && entry.access == Access::ReadWrite {
            let (index, sub_index) = entry.address;
            bench.note(format!("{index:04X}h sub {sub_index} is mapped and rw: use rwr or rww"));
        }
    }
    for fault in &faults {
        bench.note(fault);
    }
    bench.check(faults.is_empty(), "a data sheet without these faults")
}

/// The required keys of the head, and the lists of objects.
fn lists(eds: &Eds, faults: &mut Vec<String>) {
    for (section, keys) in [
        ("FileInfo", &["FileName", "FileVersion", "EDSVersion", "Description", "CreationDate"][..]),
        (
            "DeviceInfo",
            &["VendorNumber", "ProductNumber", "RevisionNumber", "Granularity", "NrOfRXPDO"],
        ),
        ("DummyUsage", &["Dummy0001", "Dummy0007"]),
        ("MandatoryObjects", &["SupportedObjects"]),
        ("OptionalObjects", &["SupportedObjects"]),
        ("ManufacturerObjects", &["SupportedObjects"]),
    ] {
        let has = |key: &&&str| {
            eds.section(section).is_some_and(|keys| keys.contains_key(&key.to_ascii_lowercase()))
        };
        let missing = keys.iter().filter(|key| !has(key));
        faults.extend(missing.map(|key| format!("[{section}] has no {key}")));
    }
    let mut listed = Vec::new();
    for (section, is_its) in [
        (
            "MandatoryObjects",
            (|index| matches!(index, 0x1000 | 0x1001 | 0x1018)) as fn(u16) -> bool,
        ),
        ("OptionalObjects", |index| !(0x2000..0x6000).contains(&index)),
        ("ManufacturerObjects", |index| (0x2000..0x6000).contains(&index)),
    ] {
        let count = eds.number(section, "SupportedObjects").unwrap_or(0).min(0xFFFF);
        for place in 1..=count {
            match eds.number(section, &place.to_string()).map(u16::try_from) {
                Some(Ok(index)) if is_its(index) => listed.push(index),
                other => faults.push(format!("[{section}] {place} is {other:X?}")),
            }
        }
    }
    listed.sort();
    if listed != eds.indices() {
        faults.push("the lists of objects are not those of the sections".into());
    }
    let count = |first: u16| {
        eds.indices().iter().filter(|index| (first..first + 0x200).contains(index)).count()
    };
    for (key, first) in [("NrOfRXPDO", 0x1400), ("NrOfTXPDO", 0x1800)] {
        if eds.number("DeviceInfo", key) != Some(count(first) as i128) {
            faults.push(format!("{key} is not {}", count(first)));
        }
    }
}

/// The sub-indices of an object that has them.
fn object(eds: &Eds, index: u16, faults: &mut Vec<String>) {
    let name = format!("{index:04X}");
    let Some(subs) = eds.number(&name, "SubNumber") else { return };
    let entries: Vec<&Entry> = eds.object(index).collect();
    if subs != entries.len() as i128 {
        faults.push(format!("[{name}] has {} sub-indices, not {subs}", entries.len()));
    }
    let highest = entries.iter().map(|entry| entry.address.1).filter(|sub| *sub < 0xFF).max();
    let first = entries.first().filter(|entry| entry.address.1 == 0);
    let is_count = first.is_some_and(|entry| entry.data_type == 5);
    if !is_count {
        faults.push(format!("[{name}sub0] is no UNSIGNED8"));
    }
    // In a mapping and in 1003h the number counts what is there.
    let varies = matches!(index, 0x1003 | 0x1600..=0x17FF | 0x1A00..=0x1BFF);
    let says = first.and_then(|entry| entry.default(1)).and_then(|bytes| bytes.first().copied());
    if !varies && says != highest {
        faults.push(format!("[{name}sub0] is {says:?}, but the highest sub-index {highest:?}"));
    }
}

/// The entries of a mapping that count by default.
fn default_mapping(eds: &Eds, entry: &Entry, faults: &mut Vec<String>) {
    let (index, sub_index) = entry.address;
    let is_rpdo = match index {
        0x1600..=0x17FF => true,
        0x1A00..=0x1BFF => false,
        _ => return,
    };
    let count = eds.get((index, 0)).and_then(|count| count.number_default(1)).unwrap_or(0);
    let default = entry.number_default(1).and_then(|default| u32::try_from(default).ok());
    let (true, Some(default)) = ((1..=count).contains(&sub_index.into()), default) else { return };
    if !eds.can_be_mapped(default, is_rpdo) {
        faults.push(format!("[{index:04X}sub{sub_index:X}]: {default:08X}h cannot be mapped"));
    }
}

fn value(entry: &Entry, faults: &mut Vec<String>) {
    let (index, sub_index) = entry.address;
    let mut fault = |text: &str| faults.push(format!("[{index:04X}sub{sub_index:X}]: {text}"));
    if entry.has_bad_default() {
        fault("the default is not of its type");
    }
    if !matches!(entry.object_type, 2 | 7) {
        fault("the object type of a value is 2 or 7");
    }
    if entry.name.is_empty() || entry.name.len() > 241 {
        fault("a name has 1 to 241 characters");
    }
    if entry.is_mappable && entry.size().is_none_or(|size| size > 8) {
        fault("a value that can be mapped has at most eight bytes");
    }
    let limits = [entry.low(1), entry.number_default(1), entry.high(1)].into_iter().flatten();
    if !limits.is_sorted() {
        fault("the default is outside of the limits");
    }
}
