//! A reader of electronic data sheets and of device configuration files (CiA 306), as tolerant as other programs' are.

mod file;

use std::{
    collections::{BTreeMap, BTreeSet, btree_map::Entry as Place},
    path::Path,
};

pub use canopen_node::object_dictionary::Access;
use file::word;
pub use file::{Fault, Line, encode};

/// Index and sub-index.
pub type Address = (u16, u8);

/// The keys of a section with their values, by name in lower case.
pub type Section = BTreeMap<String, String>;

/// A data sheet.
#[derive(Clone, Debug, Default)]
pub struct Eds {
    /// By name in lower case, with the lines of their headers.
    sections: BTreeMap<String, (usize, Section)>,
    entries: BTreeMap<Address, Entry>,
    /// What cannot be read: it is in none of the others.
    pub faults: Vec<Fault>,
    /// The text with `\n` behind each line, and whether its file is in Latin-1.
    pub text: String,
    pub is_latin: bool,
}

/// The data types of CiA 301 by what their values are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Unsigned,
    Integer,
    Real,
    Text,
    /// In UTF-16.
    Unicode,
    Octets,
    Domain,
}

/// A value of the object dictionary.
#[derive(Clone, Debug)]
pub struct Entry {
    pub address: Address,
    pub name: String,
    pub object_type: u32,
    /// As in CiA 301, table 44.
    pub data_type: u32,
    pub access: Access,
    pub is_mappable: bool,
    pub flags: u32,
    default: Option<String>,
    low: Option<String>,
    high: Option<String>,
    /// The value that a device configuration file gives to one device, as it stands there; for a DOMAIN the name of a file.
    pub value: Option<String>,
    /// The line of its section.
    pub line: usize,
    /// Texts are in Latin-1, as the file.
    is_latin: bool,
}

impl Eds {
    /// Reads a file in UTF-8, UTF-16 or Latin-1, with the line ends of any computer.
    ///
    /// # Errors
    /// In words: the file cannot be read.
    pub fn read(path: &Path) -> Result<Self, String> {
        let (text, is_latin) =
            file::read(path).map_err(|error| format!("cannot read {}: {error}", path.display()))?;
        Ok(Self::of(text, is_latin))
    }

    /// Reads a text; what of it cannot be read is among the faults.
    pub fn parse(text: &str) -> Self {
        Self::of(text.to_owned(), false)
    }

    fn of(text: String, is_latin: bool) -> Self {
        let mut eds = Self { is_latin, ..Self::default() };
        eds.read_sections(&text);
        eds.read_entries();
        eds.find_lost();
        Self { text, ..eds }
    }

    fn read_sections(&mut self, text: &str) {
        // Empty: the lines are in none.
        let mut section = String::new();
        for (line, content) in (1..).zip(text.lines()) {
            let content = content.trim();
            let mut fault = Fault { line, section: section.clone(), ..Fault::default() };
            match Line::read(content) {
                Line::Empty => continue,
                Line::Section(name) => {
                    section = name.to_ascii_lowercase();
                    match self.sections.entry(section.clone()) {
                        Place::Vacant(place) => {
                            place.insert((line, Section::new()));
                            continue;
                        }
                        Place::Occupied(first) => {
                            fault.section.clone_from(&section);
                            fault.words = format!("it is there since line {}", first.get().0);
                        }
                    }
                }
                Line::Key(key, value) => {
                    let key = key.to_ascii_lowercase();
                    match self.sections.get_mut(&section).map(|(_, keys)| keys.entry(key.clone())) {
                        Some(Place::Vacant(place)) => {
                            place.insert(value.to_owned());
                            continue;
                        }
                        Some(Place::Occupied(first)) if first.get() == value => {
                            fault.words = format!("a key twice: {content}");
                        }
                        Some(Place::Occupied(first)) => {
                            fault.words = format!("{content}, but {} before", first.get());
                            fault.twice = Some(key);
                        }
                        None => {
                            fault.words = format!("in no section: {content}");
                            fault.is_wanted = is_wanted(&key) && !value.is_empty();
                        }
                    }
                }
                Line::Unread => {
                    fault.words = format!("neither a section nor a key: {content}");
                    fault.is_wanted = is_wanted(&content.to_ascii_lowercase());
                    // It is not known what the lines behind it belong to.
                    if content.starts_with('[') {
                        section.clear();
                    }
                }
            }
            self.faults.push(fault);
        }
    }

    /// Reads the values. One that is wanted is lost if its keys say two things.
    fn read_entries(&mut self) {
        let torn = self.faults.iter().filter(|fault| fault.twice.is_some());
        let torn: BTreeSet<String> = torn.map(|fault| fault.section.clone()).collect();
        for (name, (line, section)) in &self.sections {
            let Some(address) = address(name) else { continue };
            if section.contains_key("subnumber") && section.get("datatype").is_none() {
                continue;
            }
            let is_wanted = wanted(section).next().is_some();
            let entry = match is_wanted && torn.contains(name) {
                true => Err("a key has two values".into()),
                false => Entry::read(address, section),
            };
            let entry = match entry {
                Ok(entry) => Entry { line: *line, is_latin: self.is_latin, ..entry },
                Err(words) => {
                    let (line, section, twice) = (*line, name.clone(), None);
                    self.faults.push(Fault { line, section, twice, words, is_wanted });
                    continue;
                }
            };
            match self.number(name, "CompactSubObj") {
                Some(count @ 1..=254) => {
                    let elements = self.compact(name, &entry, count as u8, &torn);
                    self.entries.extend(elements.map(|entry| (entry.address, entry)));
                }
                _ => _ = self.entries.insert(address, entry),
            }
        }
    }

    /// Finds the other wanted values that no entry has.
    fn find_lost(&mut self) {
        let known = self.faults.iter().filter(|fault| fault.is_wanted);
        let known: BTreeSet<&String> = known.map(|fault| &fault.section).collect();
        let has = |address: Address, value: &str| {
            self.get(address).is_some_and(|entry| entry.value.as_deref() == Some(value))
        };
        let mut lost = Vec::new();
        for (name, (line, section)) in &self.sections {
            let of_each = name.strip_suffix("value").and_then(address);
            let first = match (of_each, address(name)) {
                _ if known.contains(name) => None,
                (Some((index, _)), _) => section.iter().find(|(key, value)| {
                    let number = key.parse().ok().filter(|_| !value.is_empty());
                    number.is_some_and(|number| !has((index, number), value))
                }),
                // The elements of an object may share its section.
                (None, Some((index, sub_index))) => wanted(section)
                    .find(|(_, value)| !has((index, sub_index), value) && !has((index, 1), value)),
                (None, None) => wanted(section).next(),
            };
            lost.extend(first.map(|(key, value)| Fault {
                line: *line,
                section: name.clone(),
                twice: None,
                words: format!("{key}={value} belongs to no value"),
                is_wanted: true,
            }));
        }
        self.faults.extend(lost);
    }

    /// The values of an object whose elements share one section (CiA 306, CompactSubObj). Names and values that are not
    /// the same for all have sections of their own.
    fn compact(
        &self,
        section: &str,
        of_all: &Entry,
        count: u8,
        torn: &BTreeSet<String>,
    ) -> impl Iterator<Item = Entry> + use<> {
        let of_each = |kind: &str| {
            let name = format!("{section}{kind}");
            self.section(&name).filter(|_| !torn.contains(&name)).cloned()
        };
        let (names, values) = (of_each("name"), of_each("value"));
        let text = |of_each: &Option<Section>, number: u8| {
            of_each.as_ref()?.get(&number.to_string()).filter(|text| !text.is_empty()).cloned()
        };
        let (index, _) = of_all.address;
        let number_of_elements = Entry {
            address: (index, 0),
            name: "NrOfObjects".into(),
            object_type: 7,
            data_type: 5,
            access: Access::ReadOnly,
            is_mappable: false,
            flags: 0,
            default: Some(count.to_string()),
            low: None,
            high: None,
            value: None,
            ..of_all.clone()
        };
        let of_all = of_all.clone();
        let elements = (1..=count).map(move |number| Entry {
            address: (index, number),
            name: text(&names, number).unwrap_or_else(|| format!("{}{number}", of_all.name)),
            object_type: 7,
            value: text(&values, number).or_else(|| of_all.value.clone()),
            ..of_all.clone()
        });
        [number_of_elements].into_iter().chain(elements)
    }

    /// A section by its name, whatever its case.
    pub fn section(&self, name: &str) -> Option<&Section> {
        self.sections.get(&name.to_ascii_lowercase()).map(|(_, keys)| keys)
    }

    pub fn get(&self, address: Address) -> Option<&Entry> {
        self.entries.get(&address)
    }

    /// All values, by index and sub-index.
    pub fn entries(&self) -> impl Iterator<Item = &Entry> {
        self.entries.values()
    }

    /// The values of one object.
    pub fn object(&self, index: u16) -> impl Iterator<Item = &Entry> {
        self.entries.range((index, 0)..=(index, 0xFF)).map(|(_, entry)| entry)
    }

    /// Whether the object exists.
    pub fn has(&self, index: u16) -> bool {
        self.object(index).next().is_some()
    }

    /// The numbers that map the dummies in use (CiA 301, 7.4.7.3).
    pub fn dummies(&self) -> impl Iterator<Item = u32> {
        let all = (1_u32..).zip([1, 8, 16, 32, 8, 16, 32]);
        let is_used = |(index, _): &(u32, u32)| {
            self.number("DummyUsage", &format!("Dummy{index:04X}")) == Some(1)
        };
        all.filter(is_used).map(|(index, bits)| index << 16 | bits)
    }

    /// Whether this number maps a whole value, or a dummy, in an RPDO or else in a TPDO.
    pub fn can_be_mapped(&self, mapping: u32, is_rpdo: bool) -> bool {
        let value = self.get(((mapping >> 16) as u16, (mapping >> 8) as u8));
        let is_value = value.is_some_and(|value| {
            let (receives, transmits) = value.pdo_directions();
            value.mapping() == mapping && if is_rpdo { receives } else { transmits }
        });
        is_value || is_rpdo && self.dummies().any(|dummy| dummy == mapping)
    }

    /// The name of a value, with that of its object if it is one of several: `Identity object.Vendor-ID`.
    pub fn name(&self, entry: &Entry) -> String {
        let object = self.section(&format!("{:04x}", entry.address.0));
        let is_one_of_several = object.is_some_and(|section| {
            section.contains_key("subnumber") || section.contains_key("compactsubobj")
        });
        match object.and_then(|section| section.get("parametername")) {
            Some(object) if is_one_of_several => format!("{object}.{}", entry.name),
            _ => entry.name.clone(),
        }
    }

    /// The values with this name, with or without that of their object.
    pub fn with_name(&self, name: &str) -> Vec<&Entry> {
        self.entries().filter(|entry| entry.name == name || self.name(entry) == name).collect()
    }

    /// The indices of all objects.
    pub fn indices(&self) -> Vec<u16> {
        let mut all: Vec<u16> = self.entries.keys().map(|address| address.0).collect();
        all.dedup();
        all
    }

    /// The vendor-ID, the product code and the revision number. What `DeviceInfo` does not give of the first two, the
    /// defaults of 1018h do.
    pub fn identity(&self) -> [Option<u32>; 3] {
        let given = |key: &str| {
            let text = word(self.section("DeviceInfo")?.get(key)?);
            // A number with all its digits is hexadecimal, as a person writes these: 00030924.
            let value = match text.len() == 8 && text.starts_with('0') {
                true => u32::from_str_radix(text, 16).ok(),
                false => None,
            };
            value.or_else(|| u32::try_from(number(text, 0)?).ok())
        };
        let or_default = |key: &str, sub_index| {
            let default = || self.get((0x1018, sub_index))?.number_default(0)?.try_into().ok();
            let given = given(key);
            given.filter(|number| *number != 0).or_else(default).or(given)
        };
        [or_default("vendornumber", 1), or_default("productnumber", 2), given("revisionnumber")]
    }

    /// The value of a key that is a number.
    pub fn number(&self, section: &str, key: &str) -> Option<i128> {
        number(self.section(section)?.get(&key.to_ascii_lowercase())?, 0)
    }
}

/// The index and the sub-index in `2101:1`, `2101sub1`, `2100` or `0x2100`, as a person writes them.
pub fn parts(text: &str) -> Option<Address> {
    let digits = text.strip_prefix("0x").unwrap_or(text);
    let (index, sub_index) =
        digits.split_once(':').or_else(|| digits.split_once("sub")).unwrap_or((digits, "0"));
    Some((u16::from_str_radix(index, 16).ok()?, u8::from_str_radix(sub_index, 16).ok()?))
}

/// The address in the name of a section such as `1018sub4` or `1017`.
pub fn address(name: &str) -> Option<Address> {
    let (index, sub_index) = name.split_once("sub").unwrap_or((name, "0"));
    if index.len() != 4 {
        return None;
    }
    Some((u16::from_str_radix(index, 16).ok()?, u8::from_str_radix(sub_index, 16).ok()?))
}

/// Whether a key gives a device a value.
fn is_wanted(key: &str) -> bool {
    key.contains("parametervalue") || key.contains("downloadfile")
}

/// The keys of a section that do, with the values.
fn wanted(section: &Section) -> impl Iterator<Item = (&String, &String)> {
    section.iter().filter(|(key, value)| is_wanted(key) && !value.is_empty())
}

/// A number in the notation of CiA 306: decimal, 0x hexadecimal, 0 octal, and $NODEID in a sum. Before letters 0x may be
/// missing.
fn number(text: &str, node: u8) -> Option<i128> {
    let part = |text: &str| {
        let text = text.trim().to_ascii_lowercase();
        let (sign, digits) = text.strip_prefix('-').map_or((1, &*text), |digits| (-1, digits));
        if digits == "$nodeid" {
            return Some(sign * i128::from(node));
        }
        let is_decimal = digits.bytes().all(|digit| digit.is_ascii_digit());
        let (digits, radix) = match digits.strip_prefix("0x") {
            Some(hex) => (hex, 16),
            None if !is_decimal => (digits, 16),
            None if digits.len() > 1 && digits.starts_with('0') => (digits, 8),
            None => (digits, 10),
        };
        // Not a second sign.
        let is_number = digits.starts_with(|first: char| first.is_ascii_hexdigit());
        i128::from_str_radix(digits, radix).ok().filter(|_| is_number)?.checked_mul(sign)
    };
    word(text).split('+').try_fold(0_i128, |sum, summand| sum.checked_add(part(summand)?))
}

impl Entry {
    fn read(address: Address, section: &Section) -> Result<Self, String> {
        let text = |key: &str| section.get(key).filter(|value| !value.is_empty()).cloned();
        let optional = |key: &str, default: u32| match text(key) {
            None => Ok(default),
            Some(value) => number(&value, 0)
                .and_then(|value| value.try_into().ok())
                .ok_or_else(|| format!("{key}={value} is no number")),
        };
        let access = text("accesstype").unwrap_or_default().to_ascii_lowercase();
        let access = match word(&access) {
            "const" => Access::Const,
            "ro" | "r" => Access::ReadOnly,
            "rw" => Access::ReadWrite,
            "rwr" => Access::ReadWriteInput,
            "rww" => Access::ReadWriteOutput,
            "wo" | "w" => Access::WriteOnly,
            "" => return Err("no AccessType".into()),
            other => return Err(format!("AccessType={other} is unknown")),
        };
        let entry = Self {
            address,
            name: text("parametername").unwrap_or_default(),
            object_type: optional("objecttype", 7)?,
            data_type: optional("datatype", 0)?,
            access,
            is_mappable: optional("pdomapping", 0)? == 1,
            flags: optional("objflags", 0)?,
            default: text("defaultvalue"),
            low: text("lowlimit"),
            high: text("highlimit"),
            value: text("parametervalue").or_else(|| text("downloadfile")),
            line: 0,
            is_latin: false,
        };
        match entry.shape() {
            Some(_) => Ok(entry),
            None => Err(format!("DataType={:#06X} is unknown", entry.data_type)),
        }
    }

    /// What the values are, and their number of bits, 0 if that varies.
    fn shape(&self) -> Option<(Kind, u32)> {
        Some(match self.data_type {
            0x01 => (Kind::Unsigned, 8),
            0x02..=0x04 => (Kind::Integer, 8 << (self.data_type - 2)),
            0x05..=0x07 => (Kind::Unsigned, 8 << (self.data_type - 5)),
            0x08 => (Kind::Real, 32),
            0x09 => (Kind::Text, 0),
            0x0A => (Kind::Octets, 0),
            0x0B => (Kind::Unicode, 0),
            0x0F => (Kind::Domain, 0),
            0x10 => (Kind::Integer, 24),
            0x11 => (Kind::Real, 64),
            0x12..=0x15 => (Kind::Integer, 40 + 8 * (self.data_type - 0x12)),
            0x16 => (Kind::Unsigned, 24),
            0x18..=0x1B => (Kind::Unsigned, 40 + 8 * (self.data_type - 0x18)),
            _ => return None,
        })
    }

    pub fn kind(&self) -> Kind {
        self.shape().map_or(Kind::Domain, |shape| shape.0)
    }

    /// The length of a value in bytes; `None` if it varies.
    pub fn size(&self) -> Option<usize> {
        let bits = self.shape()?.1;
        (bits > 0).then_some(bits as usize / 8)
    }

    /// Whether a value is a number.
    pub fn is_number(&self) -> bool {
        matches!(self.kind(), Kind::Unsigned | Kind::Integer)
    }

    pub fn can_be_read(&self) -> bool {
        self.access != Access::WriteOnly
    }

    pub fn can_be_written(&self) -> bool {
        !matches!(self.access, Access::Const | Access::ReadOnly)
    }

    /// Whether a write would act or change the device lastingly: `ObjFlags` asks a program to leave the object out.
    pub fn acts_on_write(&self) -> bool {
        self.flags & 1 == 1
    }

    /// Whether the value may come in a RPDO, and whether it may go in a TPDO. One without a fixed length may not.
    pub fn pdo_directions(&self) -> (bool, bool) {
        use Access::*;
        let is_mappable = self.is_mappable && self.size().is_some();
        let receives = matches!(self.access, ReadWrite | ReadWriteOutput | WriteOnly);
        let transmits = matches!(self.access, ReadWrite | ReadWriteInput | ReadOnly | Const);
        (is_mappable && receives, is_mappable && transmits)
    }

    /// The number that maps the whole value in a PDO. A BOOLEAN has one bit there, and eight in an SDO.
    pub fn mapping(&self) -> u32 {
        let (index, sub_index) = self.address;
        let bits = if self.data_type == 1 { 1 } else { 8 * self.size().unwrap_or(0) as u32 };
        u32::from(index) << 16 | u32::from(sub_index) << 8 | bits
    }

    /// The value of a new device with this node-ID, as on the bus.
    pub fn default(&self, node: u8) -> Option<Vec<u8>> {
        self.parse(self.default.as_deref()?, node)
    }

    /// The default, if it is a number.
    pub fn number_default(&self, node: u8) -> Option<i128> {
        self.value_of(&self.default(node)?)
    }

    /// Whether there is a default that is not in the notation of its type.
    pub fn has_bad_default(&self) -> bool {
        self.default.as_deref().is_some_and(|text| self.parse(text, 1).is_none())
    }

    /// The lowest value, if it is a number.
    pub fn low(&self, node: u8) -> Option<i128> {
        self.limit(&self.low, node)
    }

    /// The highest value, if it is a number.
    pub fn high(&self, node: u8) -> Option<i128> {
        self.limit(&self.high, node)
    }

    /// A limit is written as a value is: 0x8000 is the lowest INTEGER16.
    fn limit(&self, text: &Option<String>, node: u8) -> Option<i128> {
        self.value_of(&self.parse(text.as_deref()?, node)?)
    }

    /// The range of the data type, if it is of numbers.
    pub fn range(&self) -> Option<(i128, i128)> {
        let bits = self.shape()?.1;
        match self.kind() {
            Kind::Unsigned => Some((0, (1 << bits) - 1)),
            Kind::Integer => Some((-(1 << (bits - 1)), (1 << (bits - 1)) - 1)),
            _ => None,
        }
    }

    /// The name of the data type.
    pub fn type_name(&self) -> String {
        let bits = self.shape().map_or(0, |shape| shape.1);
        match self.kind() {
            Kind::Unsigned if self.data_type == 1 => "BOOLEAN".into(),
            Kind::Unsigned => format!("UNSIGNED{bits}"),
            Kind::Integer => format!("INTEGER{bits}"),
            Kind::Real => format!("REAL{bits}"),
            Kind::Text => "VISIBLE_STRING".into(),
            Kind::Unicode => "UNICODE_STRING".into(),
            Kind::Octets => "OCTET_STRING".into(),
            Kind::Domain => "DOMAIN".into(),
        }
    }

    /// The limits in words if these bytes are beyond them.
    pub fn beyond(&self, bytes: &[u8], node: u8) -> Option<String> {
        let is_beyond = match self.kind() {
            Kind::Real => {
                let limit = |text: &Option<String>| self.real(&self.parse(text.as_deref()?, node)?);
                let value = self.real(bytes)?;
                limit(&self.low).is_some_and(|low| value < low)
                    || limit(&self.high).is_some_and(|high| value > high)
            }
            _ => {
                let value = self.value_of(bytes)?;
                let (low, high) = (self.low(node), self.high(node));
                // Limits that exclude each value say nothing, nor does the highest number of all bits.
                let is_unsigned = self.high.as_ref().is_some_and(|high| !high.contains('-'));
                let is_empty = match low {
                    Some(low) => high.is_some_and(|high| low > high),
                    None => is_unsigned && high.is_some_and(|high| high < 0),
                };
                let is_low = low.is_some_and(|low| value < low);
                !is_empty && (is_low || high.is_some_and(|high| value > high))
            }
        };
        let limit = |text: &Option<String>| text.clone().unwrap_or_else(|| "any".into());
        is_beyond.then(|| format!("{} to {}", limit(&self.low), limit(&self.high)))
    }

    /// The number in bytes from the bus, if they are of its length.
    fn value_of(&self, bytes: &[u8]) -> Option<i128> {
        let size = self.size().filter(|size| *size == bytes.len() && self.is_number())?;
        let value = bytes.iter().rev().fold(0_i128, |value, byte| value << 8 | i128::from(*byte));
        let is_negative = self.kind() == Kind::Integer && value >> (8 * size - 1) == 1;
        Some(if is_negative { value - (1 << (8 * size)) } else { value })
    }

    /// The same for a REAL.
    fn real(&self, bytes: &[u8]) -> Option<f64> {
        match bytes.len() {
            _ if self.kind() != Kind::Real => None,
            4 => Some(f32::from_le_bytes(bytes.try_into().ok()?).into()),
            8 => Some(f64::from_le_bytes(bytes.try_into().ok()?)),
            _ => None,
        }
    }

    /// Bytes from the bus for a person. COB-IDs, identities and mappings are easier to read in hexadecimal.
    pub fn text(&self, bytes: &[u8]) -> String {
        let is_communication = self.address.0 < 0x2000;
        match self.kind() {
            Kind::Text => {
                let text = str::from_utf8(bytes).map(str::to_owned);
                let text = text.unwrap_or_else(|_| bytes.iter().copied().map(char::from).collect());
                format!("{:?}", text.trim_end_matches('\0'))
            }
            Kind::Unicode => {
                let units =
                    bytes.chunks_exact(2).map(|unit| u16::from_le_bytes([unit[0], unit[1]]));
                let text = String::from_utf16_lossy(&units.collect::<Vec<_>>());
                format!("{:?}", text.trim_end_matches('\0'))
            }
            // Without the digits that a REAL32 does not have.
            Kind::Real if let Ok(bytes) = bytes.try_into() => f32::from_le_bytes(bytes).to_string(),
            Kind::Real if let Some(value) = self.real(bytes) => value.to_string(),
            _ => match self.value_of(bytes) {
                Some(value) if self.data_type == 7 && is_communication => format!("0x{value:08X}"),
                Some(value) => value.to_string(),
                None => bytes.iter().map(|byte| format!("{byte:02X}")).collect(),
            },
        }
    }

    /// Bytes from the bus in the notation of a device configuration file; `None` if the file cannot hold them. A REAL is
    /// its bits: not every program reads decimals there.
    pub fn notation(&self, bytes: &[u8]) -> Option<String> {
        match self.kind() {
            Kind::Text | Kind::Unicode => {
                let text = self.text(bytes);
                let text = text.strip_prefix('"')?.strip_suffix('"')?;
                let line = format!("v={text}");
                let is_as_it_is = matches!(Line::read(&line), Line::Key(_, read) if read == text);
                let is_printable = text.chars().all(|c| c == ' ' || c.is_ascii_graphic());
                // The quotes of `text` escape these.
                let is_plain = is_printable && !text.contains(['"', '\\']);
                (is_plain && is_as_it_is).then(|| text.to_owned())
            }
            Kind::Real => {
                let size = self.size().filter(|size| *size == bytes.len())?;
                let digits = bytes.iter().rev().map(|byte| format!("{byte:02X}"));
                (size > 0).then(|| format!("0x{}", digits.collect::<String>()))
            }
            Kind::Domain => None,
            _ => Some(self.text(bytes)),
        }
    }

    /// A number as on the bus, shortened to the type.
    pub fn of_number(&self, value: i128) -> Vec<u8> {
        value.to_le_bytes()[..self.size().unwrap_or(0)].to_vec()
    }

    /// A value in the notation of CiA 306 as it is on the bus of the node with this node-ID; `None` if it is not of this
    /// type.
    pub fn parse(&self, text: &str, node: u8) -> Option<Vec<u8>> {
        let length = self.size();
        match self.kind() {
            Kind::Unsigned | Kind::Integer => {
                let value = number(text, node)?;
                let (low, high) = self.range()?;
                // A negative number may stand as its bits.
                let is_possible = value >= low && value <= high.max((high - low).min(1 << 64));
                is_possible.then(|| self.of_number(value))
            }
            Kind::Real => {
                let (text, length) = (word(text), length?);
                // Not what only overflows.
                let is_infinite = !text.contains(|c: char| c.is_ascii_digit());
                match text.starts_with("0x") || text.starts_with("0X") {
                    true => {
                        let bits = number(text, 0)?;
                        (bits >> (8 * length) == 0).then(|| self.of_number(bits))
                    }
                    false => {
                        let bytes = match length {
                            4 => text.parse::<f32>().ok()?.to_le_bytes().to_vec(),
                            _ => text.parse::<f64>().ok()?.to_le_bytes().to_vec(),
                        };
                        (is_infinite || self.real(&bytes)?.is_finite()).then_some(bytes)
                    }
                }
            }
            Kind::Text => Some(encode(text, self.is_latin)),
            Kind::Unicode => Some(text.encode_utf16().flat_map(u16::to_le_bytes).collect()),
            Kind::Octets => {
                let parts = word(text).split_whitespace();
                let digits: String = parts.map(|part| part.trim_start_matches("0x")).collect();
                let is_hex = digits.bytes().all(|digit| digit.is_ascii_hexdigit());
                let pairs = (is_hex && digits.len().is_multiple_of(2)).then_some(digits.as_bytes());
                let byte = |pair: &[u8]| u8::from_str_radix(str::from_utf8(pair).ok()?, 16).ok();
                pairs?.chunks(2).map(byte).collect()
            }
            Kind::Domain => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHEET: &str = "; made by hand\r\n[DeviceInfo]\r\nLSS_Supported = 1\r\n\
        [1014]\r\nParameterName=COB-ID EMCY\r\nDataType=0x0007\r\nAccessType=rw\r\nDefaultValue=$NODEID+0x80\r\n\
        [1018]\r\nParameterName=Identity\r\nObjectType=9\r\nSubNumber=2\r\n\
        [1018sub0]\r\nParameterName=Highest\r\nDataType=5\r\nAccessType=const\r\nDefaultValue=1\r\n\
        [1018subA]\r\nParameterName=Signed\r\nDataType=0x10\r\nAccessType=RO\r\nPDOMapping=1\r\nDefaultValue=-2\r\n\
        LowLimit=-8\r\nHighLimit=010\r\n[2000]\r\nParameterName=Odd\r\nDataType=0x77\r\nAccessType=ro\r\n";

    #[test]
    fn a_sheet_with_the_notations_of_other_programs_is_read() {
        let eds = Eds::parse(SHEET);
        let faults: Vec<String> = eds.faults.iter().map(ToString::to_string).collect();
        assert_eq!(faults, ["line 26, [2000]: DataType=0x0077 is unknown"]);
        assert_eq!(eds.number("deviceinfo", "LSS_Supported"), Some(1));
        assert_eq!(eds.indices(), [0x1014, 0x1018]);
        let emergency = eds.get((0x1014, 0)).unwrap();
        assert_eq!(emergency.default(5), Some(vec![0x85, 0, 0, 0]));
        let signed = eds.get((0x1018, 10)).unwrap();
        assert_eq!(signed.default(5), Some(vec![0xFE, 0xFF, 0xFF]));
        assert_eq!((signed.low(5), signed.high(5)), (Some(-8), Some(8)));
        assert_eq!(signed.range(), Some((-0x80_0000, 0x7F_FFFF)));
        assert_eq!(signed.pdo_directions(), (false, true));
        assert_eq!(signed.mapping(), 0x1018_0A18);
    }

    #[test]
    fn a_sum_beyond_the_largest_number_is_none() {
        assert_eq!(number("170141183460469231731687303715884105727", 1), Some(i128::MAX));
        assert_eq!(number("170141183460469231731687303715884105727+1", 1), None);
        assert_eq!(number("--170141183460469231731687303715884105728", 1), None);
    }

    #[test]
    fn the_elements_of_an_array_may_share_one_section() {
        let eds = Eds::parse(
            "[1003]\nParameterName=Errors\nObjectType=8\nDataType=7\nAccessType=rw\nCompactSubObj=3\n\
             DefaultValue=5\n[1003Name]\nNrOfEntries=1\n2=Second\n[1003Value]\nNrOfEntries=1\n3=9\n",
        );
        assert!(eds.faults.is_empty(), "{:?}", eds.faults);
        let all: Vec<_> = eds.entries().map(|entry| (eds.name(entry), &entry.value)).collect();
        let nine = Some("9".to_owned());
        let expected = [
            ("Errors.NrOfObjects", &None),
            ("Errors.Errors1", &None),
            ("Errors.Second", &None),
            ("Errors.Errors3", &nine),
        ];
        assert_eq!(all, expected.map(|(name, value)| (name.to_owned(), value)));
        assert_eq!(eds.get((0x1003, 0)).unwrap().default(1), Some(vec![3]));
        assert_eq!(eds.get((0x1003, 3)).unwrap().default(1), Some(vec![5, 0, 0, 0]));
        assert_eq!(eds.with_name("Second").len(), 1);
        assert_eq!(eds.with_name("Errors.Second").len(), 1);
    }

    #[test]
    fn a_value_is_written_as_it_is_read_and_its_limits_are_known() {
        let entry = |data_type: u8, limits: &str| {
            let sheet =
                format!("[2001]\nParameterName=R\nDataType={data_type}\nAccessType=rw\n{limits}");
            Eds::parse(&sheet).get((0x2001, 0)).unwrap().clone()
        };
        let signed = entry(2, "LowLimit=-3\nHighLimit=3");
        assert_eq!(signed.notation(&[0xFE]).as_deref(), Some("-2"));
        assert_eq!(signed.beyond(&[0xFD], 1), None);
        assert_eq!(signed.beyond(&[0xFC], 1).as_deref(), Some("-3 to 3"));
        let real = entry(8, "LowLimit=0.5\nHighLimit=2");
        let half = 0.5_f32.to_le_bytes();
        assert_eq!(real.text(&half), "0.5");
        assert_eq!(real.notation(&half).as_deref(), Some("0x3F000000"));
        assert_eq!(real.parse("0x3F000000", 1), Some(half.to_vec()));
        assert_eq!(real.beyond(&half, 1), None);
        assert_eq!(real.beyond(&2.5_f32.to_le_bytes(), 1).as_deref(), Some("0.5 to 2"));
        let text = entry(9, "");
        assert_eq!(text.text(b"Ada\0"), "\"Ada\"");
        assert_eq!(text.notation(b"Ada").as_deref(), Some("Ada"));
        // A line of a file holds neither.
        assert_eq!((text.notation(b"a\nb"), text.notation(b" a")), (None, None));
        assert_eq!(entry(10, "").notation(&[1, 0xAB]).as_deref(), Some("01AB"));
    }
}
