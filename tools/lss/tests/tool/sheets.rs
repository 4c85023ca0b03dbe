//! `lss apply` with data sheets that have the habits of vendors' files, and a device of somebody else.

use std::{
    collections::{BTreeMap, VecDeque},
    fs,
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use can_bus::{
    adapter::{Adapter, Mode, Received},
    stop::Stop,
};
use canopen_node::{BitRate, Frame};
use testkit::cargo;

use crate::emulated::{Outcome, run};

const NODE: u8 = 5;
const PRE_OPERATIONAL: u8 = 127;
const OPERATIONAL: u8 = 5;

type Address = (u16, u8);
type Writes<'a> = &'a [(Address, &'a [u8])];

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Access {
    ReadOnly,
    ReadWrite,
    WriteOnly,
}
use Access::{ReadOnly, ReadWrite, WriteOnly};

/// A node without LSS: an SDO server with expedited and segmented transfers, and a heartbeat.
#[derive(Clone)]
struct Device {
    objects: BTreeMap<Address, (Access, Vec<u8>)>,
    /// The NMT state; it is told once a second.
    state: u8,
    /// Its PDOs can be mapped only in pre-operational.
    is_strict: bool,
    /// This value is refused.
    refuses: Option<(Address, &'static [u8])>,
    /// The transfer: the object, and the bytes that are left to read or have been written.
    transfer: Option<(Address, Vec<u8>)>,
    writes: Vec<(Address, Vec<u8>)>,
    answers: VecDeque<Frame>,
    start: Instant,
    time: Duration,
    next_heartbeat: Duration,
}

impl Device {
    fn new(vendor_id: u32, product_code: u32, objects: &[(Address, Access, &[u8])]) -> Self {
        let identity = [vendor_id, product_code, 3, 0x4711];
        let identity = (1..).zip(identity).map(|(sub_index, number)| {
            ((0x1018, sub_index), (ReadOnly, u32::to_le_bytes(number).to_vec()))
        });
        let objects =
            objects.iter().map(|(address, access, bytes)| (*address, (*access, bytes.to_vec())));
        let device_type = ((0x1000, 0), (ReadOnly, vec![0; 4]));
        Self {
            objects: identity.chain(objects).chain([device_type]).collect(),
            state: PRE_OPERATIONAL,
            is_strict: false,
            refuses: None,
            transfer: None,
            writes: Vec::new(),
            answers: VecDeque::new(),
            start: Instant::now(),
            time: Duration::ZERO,
            next_heartbeat: Duration::ZERO,
        }
    }

    /// What was written, the oldest first.
    fn writes(&self) -> Vec<(Address, &[u8])> {
        self.writes.iter().map(|(address, bytes)| (*address, &**bytes)).collect()
    }

    fn value(&self, address: Address) -> &[u8] {
        &self.objects[&address].1
    }

    /// The abort code with which a value cannot be written.
    fn write(&mut self, address: Address, bytes: &[u8]) -> Result<(), u32> {
        let is_off = |cob_id: u16| {
            let cob_id = self.objects.get(&(cob_id, 1));
            cob_id.is_some_and(|(_, bytes)| bytes.last().is_some_and(|byte| byte & 0x80 != 0))
        };
        if matches!(address.0, 0x1A00) {
            if !is_off(0x1800) {
                return Err(0x0604_0043);
            }
            if self.is_strict && self.state == OPERATIONAL {
                return Err(0x0800_0022);
            }
        }
        if self.refuses == Some((address, bytes)) {
            return Err(0x0609_0030);
        }
        let (access, value) = self.objects.get_mut(&address).ok_or(0x0602_0000_u32)?;
        if *access == ReadOnly {
            return Err(0x0601_0002);
        }
        *value = bytes.to_vec();
        self.writes.push((address, bytes.to_vec()));
        Ok(())
    }

    fn answer(&mut self, data: [u8; 8]) {
        self.answers.extend(Frame::new(0x580 + u16::from(NODE), &data));
    }

    fn serve(&mut self, request: [u8; 8]) {
        let [command, low, high, sub_index, data @ ..] = request;
        let address = (u16::from_le_bytes([low, high]), sub_index);
        let start = |command: u8, data: [u8; 4]| {
            let [a, b, c, d] = data;
            [command, low, high, sub_index, a, b, c, d]
        };
        let abort = |code: u32| start(0x80, code.to_le_bytes());
        let answer = match command >> 5 {
            2 => match self.objects.get(&address) {
                None => abort(0x0602_0000),
                Some((WriteOnly, _)) => abort(0x0601_0001),
                Some((_, value)) if (1..=4).contains(&value.len()) => {
                    let mut bytes = [0; 4];
                    bytes[..value.len()].copy_from_slice(value);
                    start(0x43 | (4 - value.len() as u8) << 2, bytes)
                }
                Some((_, value)) => {
                    self.transfer = Some((address, value.clone()));
                    start(0x41, (value.len() as u32).to_le_bytes())
                }
            },
            3 => {
                let (_, rest) = self.transfer.as_mut().expect("a read");
                let part: Vec<u8> = rest.drain(..rest.len().min(7)).collect();
                let is_last = u8::from(rest.is_empty());
                let mut answer = [command & 0x10 | (7 - part.len() as u8) << 1 | is_last; 8];
                answer[1..=part.len()].copy_from_slice(&part);
                answer
            }
            1 if command & 2 != 0 => {
                let length = 4 - usize::from(command >> 2 & 3);
                match self.write(address, &data[..length]) {
                    Ok(()) => start(0x60, [0; 4]),
                    Err(code) => abort(code),
                }
            }
            1 => {
                self.transfer = Some((address, Vec::new()));
                start(0x60, [0; 4])
            }
            _ => {
                let (address, bytes) = self.transfer.as_mut().expect("a write");
                bytes.extend(&request[1..8 - usize::from(command >> 1 & 7)]);
                let (address, bytes) = (*address, bytes.clone());
                match command & 1 {
                    1 if let Err(code) = self.write(address, &bytes) => {
                        let [low, high] = address.0.to_le_bytes();
                        let [a, b, c, d] = code.to_le_bytes();
                        [0x80, low, high, address.1, a, b, c, d]
                    }
                    _ => [0x20 | command & 0x10, 0, 0, 0, 0, 0, 0, 0],
                }
            }
        };
        self.answer(answer);
    }
}

/// The tool's adapter at the device.
#[derive(Clone)]
struct Wire(std::rc::Rc<std::cell::RefCell<Device>>);

impl Adapter for Wire {
    fn open(&mut self, _: BitRate, _: Mode) -> Result<(), Stop> {
        Ok(())
    }

    fn close(&mut self) -> Result<(), Stop> {
        Ok(())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Stop> {
        let mut device = self.0.borrow_mut();
        match (frame.cob_id(), frame.data()) {
            (0, &[1, NODE]) => device.state = OPERATIONAL,
            (0, &[128, NODE]) => device.state = PRE_OPERATIONAL,
            (cob_id, data) if cob_id == 0x600 + u16::from(NODE) => {
                device.serve(data.try_into().expect("8 bytes"));
            }
            _ => {}
        }
        Ok(())
    }

    fn receive(&mut self, wait: Duration) -> Result<Option<Received>, Stop> {
        let mut device = self.0.borrow_mut();
        let heartbeat = (device.time >= device.next_heartbeat).then_some(device.state);
        let frame = match heartbeat {
            Some(state) => {
                device.next_heartbeat += Duration::from_secs(1);
                Frame::new(0x700 + u16::from(NODE), &[state])
            }
            None => device.answers.pop_front(),
        };
        device.time += if frame.is_some() { Duration::from_micros(500) } else { wait };
        let (at, here) = (device.time, device.start + device.time);
        Ok(frame.map(|frame| Received { frame, at, here }))
    }

    fn now(&self) -> Instant {
        let device = self.0.borrow();
        device.start + device.time
    }

    fn description(&self) -> String {
        "a device".into()
    }
}

/// A file of these tests in a folder of its own, since a run may leave a mark beside it.
fn sheet(name: &str) -> PathBuf {
    let path = cargo::workspace().join("tools/lss/tests/tool/sheets").join(name);
    file(name, &fs::read(path).expect("a file of this repository"))
}

fn file(name: &str, text: &[u8]) -> PathBuf {
    static COUNT: AtomicUsize = AtomicUsize::new(0);
    let number = COUNT.fetch_add(1, Ordering::Relaxed).to_string();
    let folder = cargo::scratch("sheets").join(number);
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).expect("it can be made");
    let path = folder.join(name);
    fs::write(&path, text).expect("it can be written");
    path
}

/// Runs `lss apply` with a file; returns the outcome, and the device afterwards.
fn apply(file: &Path, options: &str, device: Device) -> (Outcome, Device) {
    let wire = Wire(std::rc::Rc::new(device.into()));
    let arguments = format!("apply {} {options}", file.display());
    let outcome = run(Box::new(wire.clone()), &Arc::default(), &arguments, |_| ());
    let device = wire.0.borrow().clone();
    (outcome, device)
}

/// The same with a file of this text.
fn apply_text(name: &str, text: &[u8], device: Device) -> (Outcome, Device) {
    apply(&file(name, text), "", device)
}

const WORD: Address = (0x2000, 0);
const OTHER: Address = (0x2001, 0);

/// A device 1:2:3 with these objects.
fn device(objects: &[(Address, Access, &[u8])]) -> Device {
    Device::new(1, 2, objects)
}

/// One with 2000h and 2001h, both UNSIGNED16 and rw.
fn two_words() -> Device {
    device(&[(WORD, ReadWrite, &[0; 2]), (OTHER, ReadWrite, &[0; 2])])
}

/// 500 on the bus.
const FIVE_HUNDRED: &[u8] = &[0xF4, 0x01];

#[test]
fn each_habit_of_a_file_ends_as_written_or_left_out_by_name() {
    let word = |access| device(&[(WORD, access, &[0; 2])]);
    let word_of = |vendor, product| Device::new(vendor, product, &[(WORD, ReadWrite, &[0; 2])]);
    // The file, the device, what is written, and what is left out.
    let written: Writes = &[(WORD, FIVE_HUNDRED)];
    let both: Writes = &[(WORD, FIVE_HUNDRED), (OTHER, &[7, 0])];
    let seven: Writes = &[(OTHER, &[7, 0])];
    let cases: &[(&str, Device, Writes, &str)] = &[
        ("plain.dcf", two_words(), written, ""),
        ("utf8_bom.dcf", two_words(), written, ""),
        ("utf16.dcf", two_words(), written, ""),
        ("upper_case_name.DCF", two_words(), written, ""),
        (
            "access_R_RW_as_esphome.dcf",
            device(&[(WORD, ReadWrite, &[0; 2]), (OTHER, ReadOnly, &[0; 2])]),
            written,
            "",
        ),
        ("blank_in_brackets.dcf", two_words(), both, ""),
        ("comment_behind_section.dcf", two_words(), both, ""),
        ("comment_behind_value.dcf", two_words(), written, ""),
        ("section_twice.dcf", two_words(), written, ""),
        ("no_parameter_name.dcf", two_words(), written, ""),
        ("empty_access_type.dcf", two_words(), &[], "line 12, [2000]: no AccessType"),
        (
            "time_of_day.dcf",
            device(&[(WORD, ReadWrite, &[0; 6])]),
            &[],
            "line 12, [2000]: DataType=0x000C is unknown",
        ),
        (
            "download_file_of_domain.dcf",
            device(&[(WORD, ReadWrite, &[0; 9])]),
            &[],
            "2000 X: `lss apply` writes no DOMAIN, here table.bin",
        ),
        (
            "read_only_with_value.dcf",
            device(&[(WORD, ReadOnly, &[0; 2]), (OTHER, ReadWrite, &[0; 2])]),
            seven,
            "2000 X can only be read, and is 0, not 500",
        ),
        // The board has it.
        (
            "read_only_with_value.dcf",
            device(&[(WORD, ReadOnly, FIVE_HUNDRED), (OTHER, ReadWrite, &[0; 2])]),
            seven,
            "",
        ),
        ("write_only.dcf", word(WriteOnly), written, ""),
        (
            "unreadable_one_of_two.dcf",
            device(&[(OTHER, ReadWrite, &[0; 2])]),
            seven,
            "2000 X cannot be read: there is no such object",
        ),
        ("signed_limits_in_hex.dcf", word(ReadWrite), &[(WORD, &[0xFB, 0xFF])], ""),
        ("identity_missing.dcf", word_of(0x77, 0x88), written, ""),
        ("vendor_number_hex_without_0x.dcf", word_of(0x9A, 0x30924), written, ""),
        ("latin1_text.dcf", word(ReadWrite), &[(WORD, &[0x47, 0x72, 0xF6, 0xDF, 0x65])], ""),
    ];
    for (name, device, writes, why) in cases {
        let (outcome, device) = apply(&sheet(name), "", device.clone());
        assert_ends(name, &outcome, why);
        assert_eq!(device.writes(), *writes, "{name}");
        // A second run ends in the same way and writes nothing, but for what it cannot read.
        let is_write_only = device.objects.values().any(|(access, _)| *access == WriteOnly);
        let (outcome, again) = apply(&sheet(name), "", device.clone());
        assert_ends(name, &outcome, why);
        let count = if is_write_only { 2 } else { 1 };
        assert_eq!(again.writes.len(), count * writes.len(), "{name}");
    }
    // The plan says so.
    let (outcome, _) = apply(&sheet("write_only.dcf"), "--plan", word(WriteOnly));
    let line = "2000 X: ? -> 500, each time: it can only be written";
    assert!(outcome.text.contains(line), "{}", outcome.text);
}

/// Asserts that all is as the file says, or that one value is left out for this reason.
#[track_caller]
fn assert_ends(name: &str, outcome: &Outcome, why: &str) {
    let context = format!("{name}: {}{}", outcome.text, outcome.error);
    let is_whole = outcome.text.ends_with("the network is as the files say\n");
    assert_eq!((outcome.code, is_whole), (u8::from(!why.is_empty()), why.is_empty()), "{context}");
    assert!(outcome.error.contains(why), "{context}");
    let count = outcome.error.matches("node 5: left out: ").count();
    assert_eq!(count, usize::from(!why.is_empty()), "{context}");
}

#[test]
fn values_of_each_type_are_on_the_bus_as_the_file_gives_them() {
    let wanted: [&[u8]; 11] = [
        &[0xFE],
        &[0xFE, 0xFF, 0xFF],
        &(-2_i64).to_le_bytes(),
        &1.5_f32.to_le_bytes(),
        &(-0.1_f64).to_le_bytes(),
        &[3, 2, 1],
        &[0xFF; 8],
        b"Ada Lovelace of London",
        &[1, 2, 0xAB],
        &i64::MIN.to_le_bytes(),
        &[0xBC, 0x9A, 0x78, 0x56, 0x34, 0x12],
    ];
    let addresses = (0x2000..).map(|index| (index, 0));
    let objects = addresses.clone().zip(wanted).map(|(address, _)| (address, ReadWrite, &[0][..]));
    let device = device(&objects.collect::<Vec<_>>());
    let (outcome, device) = apply(&sheet("types.dcf"), "", device);
    assert_ends("types.dcf", &outcome, "");
    assert_eq!(device.writes(), addresses.zip(wanted).collect::<Vec<_>>());
}

/// TPDO 1 as the files want it, with another transmission type and another object in its mapping.
fn tpdo() -> Device {
    device(&[
        ((0x1800, 0), ReadOnly, &[2]),
        ((0x1800, 1), ReadWrite, &COB_ID),
        ((0x1800, 2), ReadWrite, &[255]),
        ((0x1A00, 0), ReadWrite, &[1]),
        ((0x1A00, 1), ReadWrite, &[0x08, 0, 1, 0x20]),
        (WORD, ReadWrite, &[0; 2]),
    ])
}

const COB_ID: [u8; 4] = [0x85, 0x01, 0, 0];
const MAPPING: [u8; 4] = [0x10, 0, 0, 0x20];

#[test]
fn a_mapping_whose_number_of_objects_is_a_default_is_written() {
    let (outcome, device) = apply(&sheet("mapping_without_sub0.dcf"), "", tpdo());
    assert_ends("mapping", &outcome, "");
    let values = [(0x1A00, 0), (0x1A00, 1), (0x1800, 1), (0x1800, 2)].map(|at| device.value(at));
    assert_eq!(values, [&[1][..], &MAPPING, &COB_ID, &[1]]);
}

#[test]
fn a_node_goes_to_pre_operational_before_its_pdos_change_and_comes_back() {
    let file = sheet("operational_and_mapping_needs_preop.dcf");
    let strict = Device { is_strict: true, state: OPERATIONAL, ..tpdo() };
    let (outcome, device) = apply(&file, "", strict.clone());
    assert_ends("mapping", &outcome, "");
    assert_eq!((device.state, device.value((0x1A00, 1))), (OPERATIONAL, &MAPPING[..]));
    assert_eq!(device.value((0x1800, 1)), COB_ID);
    // Where it must not, the PDO is as before.
    let why = "1A00:0 M.X cannot be 0: not in the present state of the device (abort 08000022)";
    let (outcome, device) = apply(&file, "--keep-state", strict);
    assert_ends("mapping", &outcome, why);
    assert!(!outcome.error.contains("stays off"), "{}", outcome.error);
    assert_eq!((device.state, device.value((0x1800, 1))), (OPERATIONAL, &COB_ID[..]));
    assert_ne!(device.value((0x1A00, 1)), MAPPING);
}

#[test]
fn a_pdo_whose_part_is_refused_is_as_before_and_what_stays_off_is_named() {
    let file = sheet("operational_and_mapping_needs_preop.dcf");
    for (address, value, why) in [
        ((0x1800, 2), &[1][..], "1800:2 T.X cannot be 1: the value is invalid (abort 06090030)"),
        ((0x1A00, 1), &MAPPING, "1A00:1 M.X cannot be 0x20000010: the value is invalid"),
        ((0x1A00, 0), &[1], "1A00:0 M.X cannot be 1: the value is invalid"),
        ((0x1800, 1), &COB_ID, "1800:1 T.X cannot be 0x00000185: the value is invalid"),
    ] {
        let device = Device { refuses: Some((address, value)), ..tpdo() };
        let before: Vec<_> = device.objects.values().cloned().collect();
        let (outcome, mut device) = apply(&file, "", device);
        assert_ends("refused", &outcome, why);
        // The number of mapped objects and the COB-ID are refused again when the PDO is to be as before.
        let is_off = value == [1] && address == (0x1A00, 0) || address == (0x1800, 1);
        let end = if is_off { "PDO 1800 stays off" } else { "PDO 1800 is as before" };
        assert!(outcome.error.ends_with(end), "{}", outcome.error);
        assert_eq!(device.value((0x1800, 1))[3], if is_off { 0x80 } else { 0 });
        if !is_off {
            assert_eq!(device.objects.values().cloned().collect::<Vec<_>>(), before);
        }
        device.refuses = None;
        assert_ends("again", &apply(&file, "", device).0, "");
    }
}

#[test]
fn half_a_pdo_is_not_written() {
    let text =
        fs::read_to_string(sheet("operational_and_mapping_needs_preop.dcf")).expect("a file");
    let text = text.replace("ParameterValue=0x20000010", "ParameterValue=the speed");
    let (outcome, device) = apply_text("half.dcf", text.as_bytes(), tpdo());
    assert_eq!((outcome.code, device.writes.len()), (1, 0), "{}", outcome.error);
    assert!(outcome.error.contains("1A00:1 M.X: the speed is no UNSIGNED32"), "{}", outcome.error);
    for address in ["1800:1", "1800:2", "1A00:0"] {
        let words = format!("{address}, a part of this PDO");
        assert!(outcome.error.contains(&words), "{}", outcome.error);
    }
}

/// `plain.dcf` with other lines for its only value.
fn dcf(lines: &str) -> String {
    let text = fs::read_to_string(sheet("plain.dcf")).expect("a file of this repository");
    let (head, _) = text.split_once("[2000]").expect("a section");
    format!("{head}{lines}")
}

#[test]
fn what_other_programs_write_is_read_or_told() {
    let section = |lines: &str| dcf(&format!("[2000]\nParameterName=X\nAccessType=rw\n{lines}\n"));
    let word = |value: &str| section(&format!("DataType=6\nParameterValue={value}"));
    let of_type =
        |kind: &str, value: &str| section(&format!("DataType={kind}\nParameterValue={value}"));
    let behind = |lines: &str| {
        word("500") + lines + "\nParameterName=Y\nDataType=6\nAccessType=rw\nParameterValue=7\n"
    };
    // Nothing is written if a reason is there and no bytes.
    let cases: &[(String, &[u8], &str)] = &[
        // Numbers.
        (word("0X1F4"), FIVE_HUNDRED, ""),
        (word("1F4"), FIVE_HUNDRED, ""),
        (word("0764"), FIVE_HUNDRED, ""),
        (word("\t 500 \t"), FIVE_HUNDRED, ""),
        (word("\"500\""), FIVE_HUNDRED, ""),
        (word("500;half a second"), FIVE_HUNDRED, ""),
        (word("500 # half a second"), FIVE_HUNDRED, ""),
        (word("$NodeID + 0x1EF"), FIVE_HUNDRED, ""),
        (word("0x1EF+$NODEID"), FIVE_HUNDRED, ""),
        (word("5 00"), &[], "2000 X: 5 00 is no UNSIGNED16"),
        (word("0800"), &[], "2000 X: 0800 is no UNSIGNED16"),
        (word("--5"), &[], "2000 X: --5 is no UNSIGNED16"),
        (word("65536"), &[], "2000 X: 65536 is no UNSIGNED16"),
        (word("; 500"), &[], ""),
        (word(""), &[], ""),
        (of_type("8", "0.5"), &0.5_f32.to_le_bytes(), ""),
        (of_type("8", "0X3F800000"), &1_f32.to_le_bytes(), ""),
        (of_type("8", "1,5"), &[], "2000 X: 1,5 is no REAL32"),
        (of_type("8", "1e39"), &[], "2000 X: 1e39 is no REAL32"),
        (of_type("8", "0x3F8000000"), &[], "2000 X: 0x3F8000000 is no REAL32"),
        // Limits.
        (of_type("3", "-5\nLowLimit=0xFFF6\nHighLimit=-1"), &[0xFB, 0xFF], ""),
        (of_type("3", "5\nLowLimit=0\nHighLimit=0xFFFF"), &[5, 0], ""),
        (of_type("3", "5\nHighLimit=0xFFFF"), &[5, 0], ""),
        (of_type("3", "5\nHighLimit=-1"), &[], "2000 X: 5 is not within any to -1"),
        // Texts.
        (of_type("9", "Input #1; a"), b"Input #1; a", ""),
        (of_type("9", "Input #1 ; a"), b"Input #1", ""),
        (of_type("0x0B", "Aß"), &[0x41, 0, 0xDF, 0], ""),
        (of_type("0x0A", "0x01 02"), &[1, 2], ""),
        (of_type("0x0A", "123"), &[], "2000 X: 123 is no OCTET_STRING"),
        // Types.
        (of_type("0x40", "5"), &[], "[2000]: DataType=0x0040 is unknown"),
        (of_type("", "5"), &[], "[2000]: DataType=0x0000 is unknown"),
        (of_type("word", "5"), &[], "[2000]: datatype=word is no number"),
        // Sections and keys.
        (word("500").replace('\n', "\r"), FIVE_HUNDRED, ""),
        (word("500").replace('\n', "\r\n"), FIVE_HUNDRED, ""),
        (word("500") + "\0\0\x1A", FIVE_HUNDRED, ""),
        (word("500").to_uppercase().replace("0X", "0x"), FIVE_HUNDRED, ""),
        (word("500\nParameterValue=500"), FIVE_HUNDRED, ""),
        (word("500\nParameterValue=7"), &[], "[2000]: a key has two values"),
        (
            word("500").replace("Value=", "Value "),
            &[],
            "neither a section nor a key: ParameterValue 500",
        ),
        (behind("[2001"), FIVE_HUNDRED, "in no section: ParameterValue=7"),
        (behind("[2001] gain"), FIVE_HUNDRED, "in no section: ParameterValue=7"),
        (behind(";[2001]\n[x]"), FIVE_HUNDRED, "[x]: parametervalue=7 belongs to no value"),
        (behind("[0x2001]"), FIVE_HUNDRED, "[0x2001]: parametervalue=7 belongs to no value"),
        (
            section("ObjectType=8\nDataType=6\nCompactSubObj=2\n[2000Value]\n3=5"),
            &[],
            "[2000value]: 3=5 belongs to no value",
        ),
        (section("ObjectType=9\nSubNumber=1\nParameterValue=5"), &[], "parametervalue=5 belongs"),
    ];
    for (text, bytes, why) in cases {
        let (outcome, device) = apply_text("habit.dcf", text.as_bytes(), two_words());
        assert_ends(text, &outcome, why);
        let written: Vec<(Address, &[u8])> = match bytes {
            [] => Vec::new(),
            bytes => vec![(WORD, bytes)],
        };
        assert_eq!(device.writes(), written, "{text}");
    }
}

#[test]
fn a_place_in_the_network_that_cannot_be_read_is_told_before_anything_is_sent() {
    let plain = dcf("[2000]\nParameterName=X\nDataType=6\nAccessType=rw\nParameterValue=500\n");
    for (line, why) in [
        ("NodeID=5\nNodeID=6", "line 12, [devicecomissioning]: NodeID=6, but 5 before"),
        ("NodeID=five", "NodeID=five is no number"),
        ("NodeID=5\nBaudrate=125 kbit/s", "Baudrate=125 kbit/s is no number"),
        ("NodeID=5\nLSS_SerialNumber=none", "LSS_SerialNumber=none is no number"),
    ] {
        let text = plain.replace("NodeID=5", line);
        let (outcome, device) = apply_text("place.dcf", text.as_bytes(), two_words());
        assert_eq!((outcome.code, device.writes.len()), (1, 0), "{}", outcome.error);
        assert!(outcome.error.contains(why), "{}", outcome.error);
    }
    // 0 is no bit rate, and says nothing.
    let text = plain.replace("NodeID=5", "NodeID=5\nBaudrate=0\nLSS_SerialNumber=0");
    let (outcome, _) = apply_text("place.dcf", text.as_bytes(), two_words());
    assert_ends("Baudrate=0", &outcome, "");
}

#[test]
fn a_serial_number_names_the_board_though_the_file_does_not_say_who_made_it() {
    let text =
        fs::read_to_string(sheet("identity_missing.dcf")).expect("a file of this repository");
    let with =
        |serial: &str| text.replace("NodeID=5", &format!("NodeID=5\nLSS_SerialNumber={serial}"));
    let (outcome, _) = apply_text("serial.dcf", with("0x4711").as_bytes(), two_words());
    assert_ends("0x4711", &outcome, "");
    let (outcome, device) = apply_text("serial.dcf", with("0x4712").as_bytes(), two_words());
    assert!(outcome.error.contains("no board any:any:any:00004712 answers"), "{}", outcome.error);
    assert_eq!(device.writes.len(), 0);
    // The defaults of 1018h say it, too.
    let identity = "[1018sub1]\nParameterName=V\nDataType=7\nAccessType=ro\nDefaultValue=0x77\n";
    let (outcome, _) = apply_text("default.dcf", (text + identity).as_bytes(), two_words());
    assert!(outcome.error.contains("no board 00000077:any:any:any answers"), "{}", outcome.error);
}

#[test]
fn a_data_sheet_alone_says_how_it_is_used_and_its_mark_does_not_hide_its_first_section() {
    let (outcome, _) = apply(&sheet("eds_alone.eds"), "", two_words());
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.contains("eds = \"eds_alone.eds\""), "{}", outcome.error);
    let mark = sheet("bom_before_deviceinfo.eds");
    let table =
        format!("[[node]]\nid = 5\naddress = \"1:2:3:4711\"\neds = \"{}\"\n", mark.display());
    let (outcome, _) = apply_text("table.toml", table.as_bytes(), two_words());
    assert_ends("table", &outcome, "");
}
