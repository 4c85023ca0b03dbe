//! A node as it is wanted: which board it is, its node-ID, its values, and their stamp.

use std::collections::BTreeMap;

use can_bus::eds::{self, Entry, Kind};
use canopen_node::{BitRate, NodeId, lss::Address};

use super::sheet::{Board, LeftOut, Sheet, address_words};
use crate::{
    address,
    failure::{Failure, Result},
};

const STORE: u16 = 0x1010;
pub const STAMP: u16 = 0x1020;

/// A board as it is wanted.
pub struct Node {
    pub id: NodeId,
    pub name: Option<String>,
    pub board: Board,
    pub sheet: Option<Sheet>,
    /// The values to write, by index and sub-index, without the stamp.
    pub values: BTreeMap<eds::Address, Vec<u8>>,
    /// The values of the files that are not among them.
    pub left_out: Vec<LeftOut>,
    /// The stamp of the configuration (1020h), which is written last, if the board has one and can store.
    pub stamp: Option<Stamp>,
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
            Board::Kind(_) => None,
        }
    }

    /// The words for messages: `node 5 "pump"`.
    pub fn words(&self) -> String {
        let name = self.name.as_ref().map_or_else(String::new, |name| format!(" \"{name}\""));
        format!("node {}{name}", self.id)
    }

    /// What failed with this board alone, in words; a failure that ends the run stays one.
    pub fn failed(&self, failure: Failure) -> Result<String> {
        Ok(format!("{}: {}", self.words(), failure.of_board()?))
    }

    pub fn entry(&self, address: eds::Address) -> Option<&Entry> {
        self.sheet.as_ref()?.eds.get(address)
    }

    /// Whether a value on the board is the wanted one.
    pub fn is_as_wanted(&self, address: eds::Address, found: &[u8]) -> bool {
        self.values.get(&address).is_some_and(|wanted| self.is_same(address, found, wanted))
    }

    /// Whether two values are the same. Some boards put zeros behind a text.
    pub fn is_same(&self, address: eds::Address, found: &[u8], wanted: &[u8]) -> bool {
        match self.entry(address).map(Entry::kind) {
            Some(Kind::Text | Kind::Unicode) => without_zeros(found) == without_zeros(wanted),
            _ => found == wanted,
        }
    }

    /// Whether the board can store its values.
    pub fn can_store(&self) -> bool {
        self.entry((STORE, 1)).is_some_and(Entry::can_be_written)
    }

    /// `2101:1 Calibration of the temperature.Gain`.
    pub fn value_words(&self, address: eds::Address) -> String {
        let name =
            self.sheet.as_ref().and_then(|sheet| Some(sheet.eds.name(sheet.eds.get(address)?)));
        let words = address_words(address, self.sheet.as_ref());
        format!("{words} {}", name.unwrap_or_default()).trim_end().to_owned()
    }
}

/// A text without the zeros behind it.
fn without_zeros(text: &[u8]) -> &[u8] {
    let end = text.iter().rposition(|byte| *byte != 0).map_or(0, |last| last + 1);
    &text[..end]
}

/// What the files say about a board.
#[derive(Default)]
pub struct Source {
    pub address: Option<Address>,
    pub name: Option<String>,
    pub sheet: Option<Sheet>,
    /// The values in the data sheet count.
    pub has_values: bool,
    pub values: toml::Table,
}

impl Source {
    /// A configuration file alone.
    pub fn dcf(sheet: Sheet) -> Self {
        Self { sheet: Some(sheet), has_values: true, ..Self::default() }
    }

    /// The bit rate in a configuration file.
    pub fn bit_rate(&self) -> Result<Option<BitRate>, String> {
        let sheet = self.sheet.as_ref().filter(|_| self.has_values);
        sheet.map_or(Ok(None), Sheet::bit_rate)
    }

    /// The node as it is wanted; what is wrong is among the problems.
    pub fn node(self, id: NodeId, problems: &mut Vec<String>) -> Option<Node> {
        let Some(board) = self.board(problems) else {
            problems.push(
                "address = \"V:P:R:S\" says which board it is, as `lss list` prints it; or dcf names its file".into(),
            );
            return None;
        };
        let (mut values, mut left_out) = Default::default();
        match &self.sheet {
            Some(sheet) => {
                if self.has_values {
                    (values, left_out) = sheet.values(id.get());
                }
                for (key, value) in &self.values {
                    match sheet.value(key, value, id.get()) {
                        Ok((address, bytes)) => _ = values.insert(address, bytes),
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
        let mut node = Node { id, name, board, sheet: self.sheet, values, left_out, stamp: None };
        node.stamp = stamp(&mut node);
        Some(node)
    }

    fn board(&self, problems: &mut Vec<String>) -> Option<Board> {
        let Some(address) = self.address else {
            let sheet = self.sheet.as_ref().filter(|_| self.has_values);
            return match sheet?.board() {
                Ok(board) => Some(board),
                Err(why) => {
                    problems.push(why);
                    None
                }
            };
        };
        if let Some(sheet) = &self.sheet {
            let [vendor_id, product_code, _] = sheet.eds.identity();
            let kind = [vendor_id, product_code, None, None];
            if !address::is_of(&address, kind) {
                problems.push(format!(
                    "{} is the data sheet of {}, and not of {address}",
                    sheet.path.display(),
                    address::kind_text(&kind[..2])
                ));
            }
        }
        Some(Board::Address(address))
    }
}

/// The stamp of a node: as the files say, or a number that follows from the values. Without values there is none.
fn stamp(node: &mut Node) -> Option<Stamp> {
    let parts = [(STAMP, 1), (STAMP, 2)];
    let has_it = parts.iter().all(|part| node.entry(*part).is_some_and(Entry::can_be_written));
    let given = parts.map(|part| node.values.remove(&part));
    if !has_it || !node.can_store() {
        return None;
    }
    if let [Some(date), Some(time)] = &given {
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
