//! The desired state of a network, from the files of the user: which board has which node-ID and which values.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use super::{
    sheet::{Sheet, address_words, read_text},
    table,
};
use crate::{address, failure::Failure};
use can_bus::{
    adapter,
    eds::{self, Eds, Entry, Kind},
};
use canopen_node::{BitRate, NodeId, lss::Address};

const STORE: u16 = 0x1010;
pub const STAMP: u16 = 0x1020;

/// The desired state of a network.
#[derive(Default)]
pub struct Network {
    pub bit_rate: Option<BitRate>,
    pub nodes: Vec<Node>,
}

/// The desired state of a board.
pub struct Node {
    pub id: NodeId,
    pub name: Option<String>,
    pub board: Board,
    pub sheet: Option<Sheet>,
    /// The values to write, by index and sub-index, without the stamp.
    pub values: BTreeMap<eds::Address, Vec<u8>>,
    /// The stamp of the configuration (1020h), which is written last, if the board has one and can store.
    pub stamp: Option<Stamp>,
}

/// Which board is meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Board {
    Address(Address),
    /// The only board of this kind; 0: of any revision.
    Kind {
        vendor_id: u32,
        product_code: u32,
        revision_number: u32,
    },
}

/// A stamp: date and time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamp {
    pub numbers: [u32; 2],
    /// It follows from the values, so a node with this stamp has them.
    pub is_proof: bool,
}

impl Node {
    /// The LSS address of the board, if that is known.
    pub fn address(&self) -> Option<Address> {
        match self.board {
            Board::Address(address) => Some(address),
            Board::Kind { .. } => None,
        }
    }

    /// The words for messages: `node 5 "pump"`.
    pub fn words(&self) -> String {
        let name = self.name.as_ref().map_or_else(String::new, |name| format!(" \"{name}\""));
        format!("node {}{name}", self.id.get())
    }

    pub fn entry(&self, address: eds::Address) -> Option<&Entry> {
        self.sheet.as_ref()?.eds.get(address)
    }

    /// Whether a value on the board is the wished one. Some boards put zeros behind a text.
    pub fn is_as_wanted(&self, address: eds::Address, found: &[u8]) -> bool {
        let is_text = self.entry(address).is_some_and(|entry| entry.kind() == Kind::Text);
        self.values.get(&address).is_some_and(|wanted| match is_text {
            true => without_zeros(found) == without_zeros(wanted),
            false => found == wanted,
        })
    }

    /// Whether the board can store its values.
    pub fn can_store(&self) -> bool {
        self.entry((STORE, 1)).is_some_and(Entry::can_be_written)
    }

    /// `2101:1 Calibration of the temperature.Gain`.
    pub fn value_words(&self, address: eds::Address) -> String {
        let name =
            self.sheet.as_ref().and_then(|sheet| Some(sheet.eds.name(sheet.eds.get(address)?)));
        format!("{} {}", address_words(address, self.sheet.as_ref()), name.unwrap_or_default())
    }
}

/// A text without the zeros behind it.
fn without_zeros(text: &[u8]) -> &[u8] {
    let end = text.iter().rposition(|byte| *byte != 0).map_or(0, |last| last + 1);
    &text[..end]
}

impl Network {
    /// Reads tables (`.toml`), configuration files of devices (`.dcf`) and lists of nodes (`.cpj`).
    pub fn read(paths: &[PathBuf]) -> Result<Self, Failure> {
        let mut network = Self::default();
        let mut problems = Vec::new();
        for path in paths {
            let wrong = |why: String| format!("{}: {why}", path.display());
            if let Err(whys) = network.add(path) {
                problems.extend(whys.into_iter().map(wrong));
            }
        }
        if problems.is_empty() && network.nodes.is_empty() {
            problems.push("there is no node in the file".into());
        }
        problems.extend(network.contradictions());
        match problems.is_empty() {
            true => Ok(network),
            false => Err(Failure::Refused(problems.join("\n"))),
        }
    }

    fn add(&mut self, path: &Path) -> Result<(), Vec<String>> {
        let one = |why: String| vec![why];
        match path.extension().and_then(|extension| extension.to_str()).map(str::to_lowercase) {
            Some(extension) if extension == "toml" => self.add_table(path),
            Some(extension) if extension == "dcf" => {
                let sheet = Sheet::read(path).map_err(one)?;
                let id = sheet.node_id().map_err(one)?;
                self.add_node(id, Source { sheet: Some(sheet), ..Source::default() })
            }
            Some(extension) if extension == "cpj" => self.add_list(path),
            _ => Err(one("its name must end with .toml, .dcf or .cpj".into())),
        }
    }

    fn add_table(&mut self, path: &Path) -> Result<(), Vec<String>> {
        let one = |why: String| vec![why];
        let text = fs::read_to_string(path).map_err(|error| one(error.to_string()))?;
        let content = table::parse(&text).map_err(one)?;
        let folder = path.parent().unwrap_or(Path::new("."));
        let mut problems = Vec::new();
        if let Some(rate) = content.bit_rate {
            match adapter::bit_rate(&rate.to_string()) {
                Ok(rate) => self.want_rate(rate, &mut problems),
                Err(why) => problems.push(why),
            }
        }
        for entry in content.node {
            let id = entry.node_id().map_err(one)?;
            let wrong = |why: String| format!("node {}: {why}", id.get());
            for key in entry.others.keys() {
                problems.push(wrong(format!(
                    "\"{key}\" is no key of a node: id, address, name, eds, dcf and values are"
                )));
            }
            let file = match (&entry.eds, &entry.dcf) {
                (Some(_), Some(_)) => {
                    problems.push(wrong("a DCF is a data sheet too: take eds away".into()));
                    continue;
                }
                (eds, dcf) => eds.as_ref().or(dcf.as_ref()),
            };
            let sheet = match file.map(|file| Sheet::read(&folder.join(file))).transpose() {
                Ok(sheet) => sheet,
                Err(why) => {
                    problems.push(wrong(why));
                    continue;
                }
            };
            let address = entry.lss_address().map_err(one)?;
            let source = Source {
                address,
                name: entry.name,
                has_values: entry.dcf.is_some(),
                sheet,
                values: entry.values,
            };
            problems.extend(self.add_node(id, source).err().unwrap_or_default());
        }
        if problems.is_empty() { Ok(()) } else { Err(problems) }
    }

    /// A list of nodes with their configuration files (CiA 306): the first network of it.
    fn add_list(&mut self, path: &Path) -> Result<(), Vec<String>> {
        let list = Eds::parse(&read_text(path).map_err(|why| vec![why])?);
        let Some(topology) = list.section("Topology") else {
            return Err(vec!["there is no [Topology] in it".into()]);
        };
        let folder = path.parent().unwrap_or(Path::new("."));
        let mut problems = Vec::new();
        for id in (1..=127).filter_map(NodeId::new) {
            let key = |kind: &str| format!("node{}{kind}", id.get());
            if list.number("Topology", &key("Present")).unwrap_or(0) == 0 {
                continue;
            }
            let Some(file) = topology.get(&key("dcfname")).filter(|name| !name.is_empty()) else {
                problems.push(format!("node {}: Node{0}DCFName is missing", id.get()));
                continue;
            };
            // A tool on Windows writes the path with its own separators.
            match Sheet::read(&folder.join(file.replace('\\', "/"))) {
                Ok(sheet) => {
                    let name = topology.get(&key("name")).cloned();
                    let source = Source { name, sheet: Some(sheet), ..Source::default() };
                    problems.extend(self.add_node(id, source).err().unwrap_or_default());
                }
                Err(why) => problems.push(format!("node {}: {why}", id.get())),
            }
        }
        if problems.is_empty() { Ok(()) } else { Err(problems) }
    }

    fn want_rate(&mut self, rate: BitRate, problems: &mut Vec<String>) {
        match self.bit_rate.replace(rate) {
            Some(other) if other != rate => {
                problems
                    .push(format!("{rate} here, but {other} before: a network has one bit rate"));
            }
            _ => {}
        }
    }

    fn add_node(&mut self, id: NodeId, source: Source) -> Result<(), Vec<String>> {
        let mut problems = Vec::new();
        if let Some(sheet) = source.sheet.as_ref().filter(|_| source.has_values) {
            match sheet.bit_rate() {
                Ok(Some(rate)) => self.want_rate(rate, &mut problems),
                Ok(None) => {}
                Err(why) => problems.push(why),
            }
        }
        match source.node(id, &mut problems) {
            Some(node) if problems.is_empty() => {
                self.nodes.push(node);
                Ok(())
            }
            _ => {
                let words = |why| format!("node {}: {why}", id.get());
                Err(problems.into_iter().map(words).collect())
            }
        }
    }

    /// What several files say differently, and rates that a board does not have.
    fn contradictions(&self) -> Vec<String> {
        let mut problems = Vec::new();
        for (number, node) in self.nodes.iter().enumerate() {
            for other in &self.nodes[..number] {
                if other.id == node.id {
                    problems.push(format!("node-ID {} is there twice", node.id.get()));
                }
                if let (Board::Address(_), true) = (node.board, node.board == other.board) {
                    problems.push(format!("{} and {} are one board", other.words(), node.words()));
                }
            }
            if let (Some(rate), Some(sheet)) = (self.bit_rate, &node.sheet) {
                let kbit = rate.kbit_per_s();
                if sheet.eds.number("DeviceInfo", &format!("BaudRate_{kbit}")) == Some(0) {
                    let file = sheet.path.display();
                    problems.push(format!("{}: by {file} the board has no {rate}", node.words()));
                }
            }
        }
        problems
    }
}

/// What the files say about a board.
struct Source {
    address: Option<Address>,
    name: Option<String>,
    sheet: Option<Sheet>,
    /// The values in the data sheet count.
    has_values: bool,
    values: toml::Table,
}

impl Default for Source {
    /// A configuration file alone.
    fn default() -> Self {
        Self {
            address: None,
            name: None,
            sheet: None,
            has_values: true,
            values: toml::Table::new(),
        }
    }
}

impl Source {
    fn node(self, id: NodeId, problems: &mut Vec<String>) -> Option<Node> {
        let Some(board) = self.board(problems) else {
            problems.push(
                "address = \"V:P:R:S\" says which board it is, as `lss list` prints it; or dcf names its file".into(),
            );
            return None;
        };
        let mut values = BTreeMap::new();
        match &self.sheet {
            Some(sheet) => {
                if self.has_values {
                    values = sheet.values(id.get(), problems);
                }
                for (key, value) in &self.values {
                    let wish = sheet.wish(key, value, id.get());
                    match wish {
                        Ok((address, bytes)) => {
                            values.insert(address, bytes);
                        }
                        Err(why) => problems.push(why),
                    }
                }
                sheet.complete_pdos(id.get(), &mut values, problems);
            }
            None if !self.values.is_empty() => {
                problems.push("values need the data sheet of the board: eds = \"FILE\"".into());
            }
            None => {}
        }
        let name = self.name.or_else(|| {
            let section = self.sheet.as_ref()?.commissioning()?;
            section.get("nodename").filter(|name| self.has_values && !name.is_empty()).cloned()
        });
        let mut node = Node { id, name, board, sheet: self.sheet, values, stamp: None };
        node.stamp = stamp(&mut node);
        Some(node)
    }

    fn board(&self, problems: &mut Vec<String>) -> Option<Board> {
        let of_sheet = self.sheet.as_ref().map(Sheet::board);
        let Some(address) = self.address else {
            return of_sheet.filter(|_| self.has_values);
        };
        let kind = of_sheet.map(|board| match board {
            Board::Address(Address { vendor_id, product_code, .. })
            | Board::Kind { vendor_id, product_code, .. } => (vendor_id, product_code),
        });
        if let (Some(sheet), Some((vendor_id, product_code))) = (&self.sheet, kind)
            && (vendor_id, product_code) != (address.vendor_id, address.product_code)
        {
            problems.push(format!(
                "{} is the data sheet of {vendor_id:08X}:{product_code:08X}, and not of {}",
                sheet.path.display(),
                address::text(&address)
            ));
        }
        Some(Board::Address(address))
    }
}

/// The stamp of a node: as the files say, or a number that follows from the values. Without values there is none.
fn stamp(node: &mut Node) -> Option<Stamp> {
    let parts = [(STAMP, 1), (STAMP, 2)];
    let has_it = parts.iter().all(|part| node.entry(*part).is_some_and(Entry::can_be_written));
    let wished = parts.map(|part| node.values.remove(&part));
    if !has_it || !node.can_store() {
        return None;
    }
    if let [Some(date), Some(time)] = &wished {
        let number =
            |bytes: &[u8]| bytes.iter().rev().fold(0, |sum, byte| sum << 8 | u32::from(*byte));
        return Some(Stamp { numbers: [number(date), number(time)], is_proof: false });
    }
    if node.values.is_empty() {
        return None;
    }
    /// FNV-1a with 64 bits: the same values have the same stamp in each version of this program.
    const OFFSET: u64 = 0xCBF2_9CE4_8422_2325;
    const PRIME: u64 = 0x0000_0100_0000_01B3;
    let mut hash = OFFSET;
    for ((index, sub_index), bytes) in &node.values {
        let [low, high] = index.to_le_bytes();
        for byte in [low, high, *sub_index, bytes.len() as u8].iter().chain(bytes) {
            hash = (hash ^ u64::from(*byte)).wrapping_mul(PRIME);
        }
    }
    // 0 means: not configured.
    let numbers = [hash as u32, (hash >> 32) as u32].map(|number| number.max(1));
    Some(Stamp { numbers, is_proof: true })
}
