//! The release image is what its EDS says: every value is read and written by SDO.

use std::collections::BTreeMap;

use emulator::Time;
use lss_slave::{BitRate, Frame};
use lss_slave_firmware::device::DEFAULTS;
use testkit::{
    eds::parse,
    image_rig::{ImageRig, on_the_wire, settings},
};

const EDS: &str = include_str!("../../eds/lss-slave.eds");
const NODE_ID: u8 = 0x40;
const READ_ONLY: u32 = 0x0601_0002;
const WRITE_ONLY: u32 = 0x0601_0001;
const TOO_LONG: u32 = 0x0607_0012;
const TOO_SHORT: u32 = 0x0607_0013;
const OUT_OF_RANGE: [u32; 3] = [0x0609_0030, 0x0609_0031, 0x0609_0032];
const NO_OBJECT: u32 = 0x0602_0000;
const NO_SUB_INDEX: u32 = 0x0609_0011;
const NO_DATA: u32 = 0x0800_0024;

/// A value as its section in the EDS describes it.
struct Value {
    index: u16,
    sub_index: u8,
    keys: BTreeMap<String, String>,
}

impl Value {
    /// The length in bytes of a number and whether it is signed; `None` for a text.
    fn number_type(&self) -> Option<(usize, bool)> {
        match &*self.keys["DataType"] {
            "0x0001" | "0x0005" => Some((1, false)),
            "0x0002" => Some((1, true)),
            "0x0003" => Some((2, true)),
            "0x0004" => Some((4, true)),
            "0x0006" => Some((2, false)),
            "0x0007" => Some((4, false)),
            "0x0009" => None,
            other => panic!("data type {other}"),
        }
    }

    fn len(&self) -> Option<usize> {
        self.number_type().map(|(len, _)| len)
    }

    /// The number at `key`.
    fn number(&self, key: &str) -> Option<i64> {
        let text = self.keys.get(key)?;
        let (base, text) = match text.strip_prefix("$NODEID+") {
            Some(rest) => (i64::from(NODE_ID), rest),
            None => (0, text.as_str()),
        };
        let number = match text.strip_prefix("0x") {
            Some(hex) => i64::from_str_radix(hex, 16),
            None => text.parse(),
        };
        Some(base + number.expect("a number"))
    }

    /// Whether the data type has this number.
    fn can_be(&self, number: i64) -> bool {
        let (len, is_signed) = self.number_type().expect("a number");
        let numbers = 1 << (8 * len);
        let lowest = if is_signed { -numbers / 2 } else { 0 };
        (lowest..lowest + numbers).contains(&number)
    }

    fn is_writable(&self) -> bool {
        matches!(&*self.keys["AccessType"], "rw" | "wo")
    }
}

/// The values of the EDS, without the heads of objects with sub-indices.
fn values() -> Vec<Value> {
    let mut values = Vec::new();
    for (name, keys) in parse(EDS) {
        let (index, sub_index) = name.split_once("sub").unwrap_or((&name, "0"));
        let index = u16::from_str_radix(index, 16);
        let sub_index = u8::from_str_radix(sub_index, 16);
        if let (Ok(index), Ok(sub_index)) = (index, sub_index)
            && keys.contains_key("DataType")
        {
            values.push(Value { index, sub_index, keys });
        }
    }
    values
}

/// A board with this node-ID and the heartbeat time of a new device.
fn board() -> ImageRig {
    let settings = settings(NODE_ID, BitRate::Kbit1000);
    let mut bench = ImageRig::with(settings.with_heartbeat_ms(DEFAULTS.heartbeat_ms));
    bench.collect(Time::from_ms(20));
    bench
}

/// The answer to an SDO request.
fn exchange(bench: &mut ImageRig, request: [u8; 8]) -> [u8; 8] {
    let request = Frame::new(0x600 + u16::from(NODE_ID), &request).expect("a frame");
    bench.transmit(on_the_wire(&request));
    let answer_cob_id = 0x580 + u16::from(NODE_ID);
    loop {
        let frame = bench.next_frame().1.0.pop().expect("an answer");
        if frame.cob_id() == answer_cob_id {
            return frame.data().try_into().expect("eight bytes");
        }
    }
}

/// The answer to the first request of a transfer, or the abort code.
fn begin(bench: &mut ImageRig, mut request: [u8; 8], value: &Value) -> Result<[u8; 8], u32> {
    let [low, high] = value.index.to_le_bytes();
    request[1..4].copy_from_slice(&[low, high, value.sub_index]);
    let answer = exchange(bench, request);
    assert_eq!(answer[1..4], request[1..4]);
    match answer {
        [0x80, .., a, b, c, d] => Err(u32::from_le_bytes([a, b, c, d])),
        _ => Ok(answer),
    }
}

fn upload(bench: &mut ImageRig, value: &Value) -> Result<Vec<u8>, u32> {
    let answer = begin(bench, [0x40, 0, 0, 0, 0, 0, 0, 0], value)?;
    if answer[0] & 0xF3 == 0x43 {
        return Ok(answer[4..8 - usize::from(answer[0] >> 2 & 3)].to_vec());
    }
    assert_eq!(answer[0], 0x41, "a segmented transfer");
    let mut data = Vec::new();
    for toggle in [0x00, 0x10].into_iter().cycle() {
        let segment = exchange(bench, [0x60 | toggle, 0, 0, 0, 0, 0, 0, 0]);
        data.extend(&segment[1..8 - usize::from(segment[0] >> 1 & 7)]);
        if segment[0] & 1 == 1 {
            break;
        }
    }
    Ok(data)
}

fn download(bench: &mut ImageRig, value: &Value, number: i64, len: usize) -> Result<(), u32> {
    let mut request = [0; 8];
    request[0] = 0x23 | (4 - len as u8) << 2;
    request[4..4 + len].copy_from_slice(&number.to_le_bytes()[..len]);
    begin(bench, request, value).map(|answer| assert_eq!(answer[0], 0x60))
}

#[test]
fn every_value_of_the_image_has_the_length_and_the_default_of_its_eds() {
    let mut bench = board();
    let (mut defaults, values) = (0, values());
    for value in &values {
        let name = format!("[{:04X}] sub {}", value.index, value.sub_index);
        let read = match upload(&mut bench, value) {
            Err(NO_DATA) if value.index == 0x1003 && value.sub_index > 0 => continue,
            Err(WRITE_ONLY) if value.keys["AccessType"] == "wo" => continue,
            read => read.unwrap_or_else(|code| panic!("{name} is not read: {code:08X}")),
        };
        assert_ne!(value.keys["AccessType"], "wo", "{name} can be read");
        let Some(len) = value.len() else {
            assert_eq!(String::from_utf8_lossy(&read), value.keys["DefaultValue"], "{name}");
            defaults += 1;
            continue;
        };
        assert_eq!(read.len(), len, "{name}");
        if let Some(default) = value.number("DefaultValue") {
            assert_eq!(read, default.to_le_bytes()[..len], "{name}");
            defaults += 1;
        }
    }
    assert!(values.len() >= 35 && defaults >= 19, "{} values, {defaults} defaults", values.len());
}

#[test]
fn every_value_of_the_image_is_writable_only_if_its_eds_says_so() {
    let mut bench = board();
    let mut writable = Vec::new();
    for value in &values() {
        let name = format!("[{:04X}] sub {}", value.index, value.sub_index);
        if !value.is_writable() {
            assert_eq!(
                download(&mut bench, value, 1, value.len().unwrap_or(4)),
                Err(READ_ONLY),
                "{name}"
            );
            continue;
        }
        let len = value.len().expect("a number");
        if len < 4 {
            assert_eq!(download(&mut bench, value, 0, len + 1), Err(TOO_LONG), "{name}");
        }
        if len > 1 {
            assert_eq!(download(&mut bench, value, 0, len - 1), Err(TOO_SHORT), "{name}");
        }
        let acts = value.keys.contains_key("ObjFlags");
        if let (Some(default), false) = (value.number("DefaultValue"), acts) {
            assert_eq!(download(&mut bench, value, default, len), Ok(()), "{name}");
            writable.push((value.index, value.sub_index));
        }
    }
    assert!(writable.starts_with(&[(0x1017, 0), (0x1029, 1)]), "{writable:X?}");
}

/// Whether the value is this number, or cannot be read because it is write-only.
fn holds(bench: &mut ImageRig, value: &Value, number: i64) -> bool {
    match upload(bench, value) {
        Err(WRITE_ONLY) => value.keys["AccessType"] == "wo",
        read => read.is_ok_and(|read| read == number.to_le_bytes()[..read.len()]),
    }
}

#[test]
fn every_value_of_the_image_keeps_the_limits_of_its_eds() {
    let mut bench = board();
    let mut limited = Vec::new();
    for value in &values() {
        let (Some(low), Some(high)) = (value.number("LowLimit"), value.number("HighLimit")) else {
            continue;
        };
        let len = value.len().expect("a number");
        for legal in [low, high] {
            assert_eq!(download(&mut bench, value, legal, len), Ok(()));
            assert!(holds(&mut bench, value, legal));
        }
        for number in [low - 1, high + 1].into_iter().filter(|&number| value.can_be(number)) {
            let code = download(&mut bench, value, number, len).expect_err("out of its limits");
            assert!(OUT_OF_RANGE.contains(&code), "{code:08X}");
            assert!(holds(&mut bench, value, high));
        }
        limited.push(value.index);
    }
    assert!(limited.contains(&0x1029), "{limited:X?}");
}

#[test]
fn the_image_has_no_value_beside_those_of_its_eds() {
    let mut bench = board();
    let values = values();
    let last =
        |index| values.iter().filter(|value| value.index == index).map(|v| v.sub_index).max();
    // The areas of the communication profile that a node of this kind could have, and the neighbours of its own.
    let indices = (0x1000..0x1030).chain([0x1200, 0x1280, 0x1400, 0x1600, 0x1800, 0x1A00, 0x1FFF]);
    for index in indices.chain([0x1F80, 0x2000, 0x2001, 0x2100, 0x5FFF, 0x6000, 0x9FFF]) {
        let (sub_index, code) = match last(index) {
            Some(last) => (last + 1, NO_SUB_INDEX),
            None => (0, NO_OBJECT),
        };
        let missing = Value { index, sub_index, keys: BTreeMap::new() };
        assert_eq!(upload(&mut bench, &missing), Err(code), "[{index:04X}] sub {sub_index}");
    }
}
