//! The release image is what its EDS says, the default one and that of the example `io`: every value is read and
//! written by SDO.

use std::{collections::BTreeMap, ops::Range};

use example_io as io;
use firmware::device::DEFAULTS;
use testkit::eds::parse;

use crate::rig::*;

const NODE_ID: u8 = 0x40;
const READ_ONLY: u32 = 0x0601_0002;
const WRITE_ONLY: u32 = 0x0601_0001;
const TOO_LONG: u32 = 0x0607_0012;
const TOO_SHORT: u32 = 0x0607_0013;
const OUT_OF_RANGE: [u32; 3] = [0x0609_0030, 0x0609_0031, 0x0609_0032];
const NO_OBJECT: u32 = 0x0602_0000;
const NO_SUB_INDEX: u32 = 0x0609_0011;
const NO_DATA: u32 = 0x0800_0024;
/// The parameters of PDOs, which change by a procedure of their own.
const PDOS: Range<u16> = 0x1400..0x1C00;
/// The temperature of the example is measured: it has not kept its default.
const MEASURED: (u16, u8) = (0x6401, 1);

/// The gain of the example is a REAL, whose default and limits a data sheet leaves out.
const GAIN: (u16, u8) = (0x2101, 1);
const OF_GAIN: [(&str, &str); 3] = [("LowLimit", "0.5"), ("HighLimit", "2"), ("DefaultValue", "1")];

/// A value as its section in the EDS describes it.
struct Value {
    index: u16,
    sub_index: u8,
    keys: BTreeMap<String, String>,
}

impl Value {
    /// The length of a number in bytes; none for a text and a domain.
    fn len(&self) -> Option<usize> {
        match &*self.keys["DataType"] {
            "0x0005" => Some(1),
            "0x0003" | "0x0006" => Some(2),
            "0x0007" | "0x0008" => Some(4),
            "0x0015" => Some(8),
            "0x0009" | "0x000F" => None,
            other => panic!("data type {other}"),
        }
    }

    fn is_real(&self) -> bool {
        self.keys["DataType"] == "0x0008"
    }

    fn is_domain(&self) -> bool {
        self.keys["DataType"] == "0x000F"
    }

    fn is(&self, access: &str) -> bool {
        self.keys["AccessType"] == access
    }

    /// The bytes of the value at `key`.
    fn bytes(&self, key: &str) -> Option<Vec<u8>> {
        let text = self.keys.get(key)?;
        let Some(len) = self.len() else { return Some(text.as_bytes().to_vec()) };
        if self.is_real() {
            return Some(text.parse::<f32>().expect("a number").to_le_bytes().to_vec());
        }
        let (base, text) = match text.strip_prefix("$NODEID+") {
            Some(rest) => (i64::from(NODE_ID), rest),
            None => (0, text.as_str()),
        };
        let number = match text.strip_prefix("0x") {
            Some(hex) => i64::from_str_radix(hex, 16),
            None => text.parse(),
        };
        Some((base + number.expect("a number")).to_le_bytes()[..len].to_vec())
    }

    /// The values of the type next to the limits, beyond them: those with limits are REAL32, or UNSIGNED8 that
    /// begins or ends with its type.
    fn beyond(&self) -> Vec<Vec<u8>> {
        let limits = ["LowLimit", "HighLimit"].map(|key| self.keys[key].as_str());
        if self.is_real() {
            let [low, high] = limits.map(|limit| limit.parse::<f32>().expect("a number"));
            let numbers = [low.next_down(), high.next_up(), f32::NAN, f32::INFINITY];
            return numbers.map(|number| number.to_le_bytes().to_vec()).to_vec();
        }
        assert_eq!(self.len(), Some(1));
        match limits.map(|limit| limit.parse::<u8>().expect("a number")) {
            [0, high] => vec![vec![high + 1]],
            [low, 0xFF] => vec![vec![low - 1]],
            both => panic!("{}: {both:?}", self.name()),
        }
    }

    fn name(&self) -> String {
        format!("[{:04X}] sub {}", self.index, self.sub_index)
    }

    fn upload(&self, rig: &mut ImageRig) -> Result<Vec<u8>, u32> {
        rig.sdo_client(NODE_ID).upload(self.index, self.sub_index)
    }

    fn download(&self, rig: &mut ImageRig, data: &[u8]) -> Result<(), u32> {
        rig.sdo_client(NODE_ID).download(self.index, self.sub_index, data)
    }
}

/// The values of an EDS, without the heads of objects with sub-indices.
fn values(eds: &str) -> Vec<Value> {
    let mut values = Vec::new();
    for (name, keys) in parse(eds) {
        let (index, sub_index) = name.split_once("sub").unwrap_or((&name, "0"));
        let index = u16::from_str_radix(index, 16);
        let sub_index = u8::from_str_radix(sub_index, 16);
        if let (Ok(index), Ok(sub_index)) = (index, sub_index)
            && keys.contains_key("DataType")
        {
            let mut keys = keys;
            if (index, sub_index) == GAIN {
                keys.extend(OF_GAIN.map(|(key, value)| (key.to_owned(), value.to_owned())));
            }
            values.push(Value { index, sub_index, keys });
        }
    }
    values
}

/// A board with the default image and one with the example, each with the values of its EDS. They have this node-ID and
/// the heartbeat time of a new device.
fn boards() -> [(ImageRig, Vec<Value>); 2] {
    let of = |defaults: Settings| {
        settings(NODE_ID, BitRate::Kbit1000).with_heartbeat_ms(defaults.heartbeat_ms)
    };
    let default = (board_with(0, of(DEFAULTS)), include_str!("../../eds/lss-slave.eds"));
    let example = (example_board(of(io::device::DEFAULTS)), include_str!("../../eds/io.eds"));
    [default, example].map(|(board, eds)| {
        let mut rig = ImageRig::new(BitRate::Kbit1000, [board]);
        rig.collect(Time::from_ms(20));
        (rig, values(eds))
    })
}

#[test]
fn every_value_of_the_image_has_the_length_and_the_default_of_its_eds() {
    let mut counts = Vec::new();
    for (mut rig, values) in boards() {
        let mut defaults = 0;
        for value in &values {
            let name = value.name();
            if value.is_domain() {
                let read = rig.sdo_client(NODE_ID).block_upload(value.index, value.sub_index, 127);
                assert!(read.is_ok_and(|read| !read.is_empty()), "{name}");
                continue;
            }
            let read = match value.upload(&mut rig) {
                Err(NO_DATA) if value.index == 0x1003 && value.sub_index > 0 => continue,
                Err(WRITE_ONLY) if value.is("wo") => continue,
                read => read.unwrap_or_else(|code| panic!("{name} is not read: {code:08X}")),
            };
            assert!(!value.is("wo"), "{name} can be read");
            assert!(value.len().is_none_or(|len| read.len() == len), "{name}: {read:?}");
            if let Some(default) = value.bytes("DefaultValue")
                && (value.index, value.sub_index) != MEASURED
            {
                assert_eq!(read, default, "{name}");
                defaults += 1;
            }
        }
        counts.push((values.len(), defaults));
    }
    assert!(counts[0] >= (35, 19) && counts[1] >= (95, 70), "values and defaults: {counts:?}");
}

#[test]
fn every_value_of_the_image_is_writable_only_if_its_eds_says_so() {
    let mut all = Vec::new();
    for (mut rig, values) in boards() {
        let mut writable = Vec::new();
        for value in &values {
            let name = value.name();
            let len = value.len().unwrap_or(4);
            let mut download = |len: usize| value.download(&mut rig, &vec![0; len]);
            if value.is("ro") || value.is("const") {
                assert_eq!(download(len), Err(READ_ONLY), "{name}");
                continue;
            }
            if value.is_domain() {
                // The application knows what it expects.
                assert_ne!(download(len), Err(READ_ONLY), "{name}");
                continue;
            }
            if value.len().is_some() {
                assert_eq!(download(len + 1), Err(TOO_LONG), "{name}");
                assert!(len == 1 || download(len - 1) == Err(TOO_SHORT), "{name}");
            }
            let acts = value.keys.contains_key("ObjFlags") || PDOS.contains(&value.index);
            if let (Some(default), false) = (value.bytes("DefaultValue"), acts) {
                assert_eq!(value.download(&mut rig, &default), Ok(()), "{name}");
                writable.push((value.index, value.sub_index));
            }
        }
        all.push(writable);
    }
    let of_firmware =
        [(0x1014, 0), (0x1015, 0), (0x1017, 0), (0x1020, 1), (0x1020, 2), (0x1029, 1)];
    assert_eq!(all[0], of_firmware);
    let of_example: Vec<_> = all[1].iter().filter(|(index, _)| *index >= 0x2000).collect();
    let expected = [(0x2100, 0), (0x2101, 1), (0x2101, 2), (0x2101, 3), (0x6200, 1), (0x6426, 1)];
    assert!(of_example.into_iter().eq(&expected), "{all:X?}");
}

#[test]
fn every_writable_number_of_the_image_takes_its_default_in_segments() {
    let mut written = [0; 2];
    for (written, (mut rig, values)) in written.iter_mut().zip(boards()) {
        let is_number = |value: &&Value| value.len().is_some() && !PDOS.contains(&value.index);
        for value in values.iter().filter(is_number) {
            let acts = value.keys.contains_key("ObjFlags");
            let Some(default) = value.bytes("DefaultValue") else { continue };
            if acts || value.is("ro") || value.is("const") {
                continue;
            }
            for size in [None, Some(default.len() as u32)] {
                let mut client = rig.sdo_client(NODE_ID);
                let outcome =
                    client.download_segments(value.index, value.sub_index, &default, size);
                assert_eq!(outcome, Ok(()), "{}, size {size:?}", value.name());
            }
            *written += 1;
        }
    }
    assert!(written[0] >= 6 && written[1] >= 14, "{written:?}");
}

#[test]
fn every_value_of_the_image_keeps_the_limits_of_its_eds() {
    let mut limited = Vec::new();
    for (mut rig, values) in boards() {
        let has_limits = |value: &&Value| value.keys.contains_key("LowLimit");
        for value in values.iter().filter(has_limits).filter(|v| !PDOS.contains(&v.index)) {
            let [low, high] = ["LowLimit", "HighLimit"].map(|key| value.bytes(key).unwrap());
            for legal in [low, high.clone()] {
                assert_eq!(value.download(&mut rig, &legal), Ok(()), "{}", value.name());
                assert_eq!(value.upload(&mut rig), Ok(legal), "{}", value.name());
            }
            for number in value.beyond() {
                let code = value.download(&mut rig, &number).expect_err("out of its limits");
                assert!(OUT_OF_RANGE.contains(&code), "{}: {code:08X}", value.name());
                assert_eq!(value.upload(&mut rig).as_ref(), Ok(&high), "{}", value.name());
            }
            limited.push(value.index);
        }
    }
    assert_eq!(limited, [0x1029, 0x1019, 0x1029, 0x2100, 0x2101, 0x2FF0]);
}

#[test]
fn the_image_has_no_value_beside_those_of_its_eds() {
    for (mut rig, values) in boards() {
        let last = |index| {
            values.iter().filter(|value| value.index == index).map(|value| value.sub_index).max()
        };
        // The areas of the communication profile that a node of this kind could have, and the neighbours of its own.
        let indices = (0x1000..0x1030)
            .chain([0x1200, 0x1280, 0x1400, 0x1401, 0x1600, 0x1601, 0x1800, 0x1802])
            .chain([0x1A00, 0x1A02, 0x1F80, 0x1FFF, 0x2000, 0x2001, 0x2100, 0x2101, 0x2103])
            .chain([0x5FFF, 0x6000, 0x6001, 0x9FFF]);
        for index in indices {
            let (sub_index, code) = match last(index) {
                Some(last) => (last + 1, NO_SUB_INDEX),
                None => (0, NO_OBJECT),
            };
            let read = rig.sdo_client(NODE_ID).upload(index, sub_index);
            assert_eq!(read, Err(code), "{index:04X}h sub {sub_index}");
        }
    }
}
