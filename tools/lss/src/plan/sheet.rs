//! The data sheet of a board: which board it is, and which bytes a value of the user is.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::{Path, PathBuf},
};

use can_bus::{
    adapter,
    eds::{self, Eds, Entry, Fault, Kind},
};
use canopen_node::{BitRate, NodeId, lss::Address};
use toml::Value as Toml;

/// The node-ID and the bit rate in boards of this repository, which LSS sets.
const SETTINGS_BY_SDO: (u16, &str) = (0x2FF0, "Node-ID and bit rate");

/// Which board is meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Board {
    Address(Address),
    /// The only board of this kind: vendor-ID, product code, revision number and serial number, as far as they are known.
    Kind([Option<u32>; 4]),
}

/// A data sheet, and its file.
pub struct Sheet {
    pub eds: Eds,
    pub path: PathBuf,
}

/// A value of a file that is not written.
pub struct LeftOut {
    /// Where it stands, and why.
    pub words: String,
    /// The board may have it all the same.
    pub value: Option<(eds::Address, Vec<u8>)>,
}

/// `2101:1`, or `2100` for an object with one value.
pub fn address_words((index, sub_index): eds::Address, sheet: Option<&Sheet>) -> String {
    let is_alone = sheet.is_some_and(|sheet| sheet.eds.object(index).count() == 1);
    match sub_index {
        0 if is_alone => format!("{index:04X}"),
        _ => format!("{index:04X}:{sub_index:X}"),
    }
}

/// The PDO that a parameter belongs to, by the index of its communication parameters.
pub fn pdo((index, _): eds::Address) -> Option<u16> {
    matches!(index, 0x1400..=0x1BFF).then_some(index & !0x200)
}

impl Sheet {
    pub fn read(path: &Path) -> Result<Self, String> {
        let eds = Eds::read(path)?;
        if eds.section("DeviceInfo").is_none() {
            return Err(format!("{} is no data sheet: there is no [DeviceInfo]", path.display()));
        }
        Ok(Self { eds, path: path.to_owned() })
    }

    /// The section on the place of the device in its network. CiA 306 spells it with one m.
    pub fn commissioning(&self) -> Option<&eds::Section> {
        let section = |name| self.eds.section(name);
        section("DeviceComissioning").or_else(|| section("DeviceCommissioning"))
    }

    /// A number there, if there is one.
    fn commissioning_number(&self, key: &str) -> Result<Option<u32>, String> {
        for section in ["DeviceComissioning", "DeviceCommissioning"] {
            let mut faults = self.eds.faults.iter();
            let is_it = |fault: &&Fault| {
                let is_key = |twice: &String| twice.eq_ignore_ascii_case(key);
                fault.section.eq_ignore_ascii_case(section)
                    && fault.twice.as_ref().is_some_and(is_key)
            };
            if let Some(fault) = faults.find(is_it) {
                return Err(fault.to_string());
            }
            let text = self.eds.section(section).and_then(|keys| keys.get(&key.to_lowercase()));
            if let Some(text) = text.filter(|text| !text.is_empty()) {
                let number =
                    self.eds.number(section, key).and_then(|number| number.try_into().ok());
                return number.map(Some).ok_or_else(|| format!("{key}={text} is no number"));
            }
        }
        Ok(None)
    }

    pub fn node_id(&self) -> Result<NodeId, String> {
        let id = self.commissioning_number("NodeID")?.and_then(|id| u8::try_from(id).ok());
        id.and_then(NodeId::new).ok_or_else(|| {
            "NodeID in [DeviceComissioning] must say which node-ID the board is to have, 1 to 127".into()
        })
    }

    pub fn bit_rate(&self) -> Result<Option<BitRate>, String> {
        match self.commissioning_number("Baudrate")? {
            None | Some(0) => Ok(None),
            Some(rate) => adapter::bit_rate(&rate.to_string()).map(Some),
        }
    }

    pub fn board(&self) -> Result<Board, String> {
        let [vendor_id, product_code, revision_number] = self.eds.identity();
        let serial_number = self.commissioning_number("LSS_SerialNumber")?;
        let is_given = |number: &u32| *number != 0;
        Ok(match (vendor_id, product_code, revision_number, serial_number.filter(is_given)) {
            (Some(vendor), Some(product), Some(revision), Some(serial)) => {
                Board::Address(Address::from([vendor, product, revision, serial]))
            }
            (_, _, revision_number, serial_number) => Board::Kind([
                vendor_id,
                product_code,
                revision_number.filter(is_given),
                serial_number,
            ]),
        })
    }

    /// Whether a value configures the board, and neither acts nor belongs to LSS.
    pub fn configures(&self, entry: &Entry) -> bool {
        let (index, _) = entry.address;
        let (settings, name) = SETTINGS_BY_SDO;
        let is_settings = index == settings && self.eds.name(entry).starts_with(name);
        entry.can_be_written()
            && entry.kind() != Kind::Domain
            && !entry.acts_on_write()
            && !matches!(index, 0x1003 | 0x1010 | 0x1011)
            && !is_settings
    }

    /// The values of a configuration file, and those that cannot be written.
    pub fn values(&self, node: u8) -> (BTreeMap<eds::Address, Vec<u8>>, Vec<LeftOut>) {
        let mut values = BTreeMap::new();
        let words = |words: String| format!("{} {words}", self.path.display());
        let lost = self.eds.faults.iter().filter(|fault| fault.is_wanted);
        let of_fault = |fault: &Fault| LeftOut { words: words(fault.to_string()), value: None };
        let mut left_out: Vec<LeftOut> = lost.clone().map(of_fault).collect();
        // Half a PDO would be another one.
        let mut torn: BTreeSet<u16> =
            lost.filter_map(|fault| pdo(eds::address(&fault.section)?)).collect();
        for entry in self.eds.entries() {
            let Some(text) = &entry.value else { continue };
            let (why, value) = match self.bytes(entry, text, node) {
                Ok(bytes) if self.configures(entry) => {
                    values.insert(entry.address, bytes);
                    continue;
                }
                Ok(bytes) => {
                    let is_read_only = !entry.can_be_written();
                    let why = if is_read_only { "can only be read" } else { "is no value to set" };
                    (format!("{} {why}", self.words(entry)), Some((entry.address, bytes)))
                }
                Err(why) => {
                    torn.extend(pdo(entry.address));
                    (why, None)
                }
            };
            let words = words(format!("line {}: {why}", entry.line));
            left_out.push(LeftOut { words, value });
        }
        let is_torn = |address: &eds::Address, _: &mut _| {
            pdo(*address).is_some_and(|pdo| torn.contains(&pdo))
        };
        for (address, _) in values.extract_if(.., is_torn) {
            let name = address_words(address, Some(self));
            left_out
                .push(LeftOut { words: words(format!("{name}, a part of this PDO")), value: None });
        }
        (values, left_out)
    }

    /// A value of the table: where it is, and its bytes.
    pub fn value(
        &self,
        key: &str,
        value: &Toml,
        node: u8,
    ) -> Result<(eds::Address, Vec<u8>), String> {
        let entry = self.named(key)?;
        let words = self.words(entry);
        if !entry.can_be_written() {
            return Err(format!("{words} can only be read"));
        }
        if !self.configures(entry) {
            return Err(format!(
                "{words} is no value to set: `lss apply` stores by itself, and node-ID and bit rate are keys"
            ));
        }
        let text = match (value, entry.kind()) {
            (Toml::String(text), _) => text.clone(),
            (_, Kind::Text | Kind::Unicode | Kind::Octets) => {
                return Err(format!("{words}: write it in quotes"));
            }
            (Toml::Integer(number), _) => number.to_string(),
            (Toml::Float(number), Kind::Real) => number.to_string(),
            (Toml::Boolean(is_set), Kind::Unsigned) => u8::from(*is_set).to_string(),
            _ => return Err(self.no_value(entry, &value.to_string())),
        };
        Ok((entry.address, self.written(entry, &text, node)?))
    }

    /// The bytes of a value, if it is one and within its limits.
    pub fn bytes(&self, entry: &Entry, text: &str, node: u8) -> Result<Vec<u8>, String> {
        let bytes = entry.parse(text, node).ok_or_else(|| self.no_value(entry, text))?;
        match entry.beyond(&bytes, node) {
            Some(limits) => {
                let (words, text) = (self.words(entry), entry.text(&bytes));
                Err(format!("{words}: {text} is not within {limits}"))
            }
            None => Ok(bytes),
        }
    }

    /// The same of a value that a person wrote. A data sheet's habits are slips there: `face` for 0xFACE, 0500 for 320.
    pub fn written(&self, entry: &Entry, text: &str, node: u8) -> Result<Vec<u8>, String> {
        let is_plain = |summand: &str| {
            let digits = summand.trim().trim_start_matches('-').to_ascii_lowercase();
            digits.starts_with("0x")
                || digits == "$nodeid"
                || digits.parse::<u64>().is_ok_and(|number| number.to_string() == digits)
        };
        let is_number = matches!(entry.kind(), Kind::Unsigned | Kind::Integer);
        if is_number && !text.split('+').all(is_plain) {
            return Err(self.no_value(entry, text) + ": write it as 500 or 0x1F4");
        }
        self.bytes(entry, text, node)
    }

    /// The value with this name, or with this index and sub-index.
    pub fn named(&self, key: &str) -> Result<&Entry, String> {
        match self.eds.with_name(key)[..] {
            [entry] => return Ok(entry),
            [] => {}
            ref several => {
                let words: Vec<String> = several.iter().map(|entry| self.words(entry)).collect();
                return Err(format!("several values are called \"{key}\": {}", words.join(", ")));
            }
        }
        eds::parts(key).and_then(|address| self.eds.get(address)).ok_or_else(|| {
            let file = self.path.display();
            format!("\"{key}\" is not in {file}: write a name of it, or \"2101:1\" for index and sub-index")
        })
    }

    fn words(&self, entry: &Entry) -> String {
        format!("{} {}", address_words(entry.address, Some(self)), self.eds.name(entry))
    }

    fn no_value(&self, entry: &Entry, text: &str) -> String {
        if entry.kind() == Kind::Domain {
            return format!("{}: `lss apply` writes no DOMAIN, here {text}", self.words(entry));
        }
        format!("{}: {text} is no {}", self.words(entry), entry.type_name())
    }

    /// A PDO is switched off while its mapping, inhibit time or SYNC start value change, so its COB-ID must be known:
    /// the wanted one, or the default.
    pub fn complete_pdos(
        &self,
        node: u8,
        values: &mut BTreeMap<eds::Address, Vec<u8>>,
        problems: &mut Vec<String>,
    ) {
        let wanted: Vec<eds::Address> = values.keys().copied().collect();
        for address in wanted {
            let (index, sub_index) = address;
            let is_mapping = matches!(index, 0x1600..=0x17FF | 0x1A00..=0x1BFF);
            let is_fixed =
                matches!(index, 0x1400..=0x15FF | 0x1800..=0x19FF) && matches!(sub_index, 3 | 6);
            if is_mapping && !values.contains_key(&(index, 0)) {
                let count = self.eds.get((index, 0)).and_then(|count| count.default(node));
                match count.filter(|count| count.first().is_some_and(|count| *count >= sub_index)) {
                    Some(count) => _ = values.insert((index, 0), count),
                    None => problems.push(format!(
                        "{}: {index:04X}:0 is missing: the number of mapped objects belongs to a mapping",
                        address_words(address, Some(self))
                    )),
                }
            }
            let cob_id = (if is_mapping { index - 0x200 } else { index }, 1);
            if !is_mapping && !is_fixed || values.contains_key(&cob_id) {
                continue;
            }
            match self.eds.get(cob_id).and_then(|entry| entry.default(node)) {
                Some(default) => {
                    values.insert(cob_id, default);
                }
                None => problems.push(format!(
                    "{}: {:04X}:1 is missing: the PDO is off while this changes, and needs its COB-ID then",
                    address_words(address, Some(self)),
                    cob_id.0
                )),
            }
        }
    }
}
