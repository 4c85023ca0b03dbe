//! The table of a network, `network.toml`: which LSS address has which node-ID, and what else `lss apply` reads there.

use std::{
    collections::BTreeSet,
    fs::{self, File},
    io::{self, ErrorKind, Write},
    path::{Path, PathBuf},
};

use canopen_node::{NodeId, lss::Address};
use serde::Deserialize;
use toml_edit::{DocumentMut, Item, TableLike, Value};

use crate::{
    address,
    failure::{Failure, Result},
};

/// The table, and the file that it grows in.
pub struct Table {
    path: PathBuf,
    pub entries: Vec<(NodeId, Address)>,
    /// All node-IDs of the table, also those of boards that only a data sheet names.
    pub ids: BTreeSet<u8>,
}

/// What stands in the file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Content {
    /// In kbit/s.
    pub bit_rate: Option<u16>,
    #[serde(default)]
    pub node: Vec<Entry>,
}

/// A board of the table.
#[derive(Deserialize)]
pub struct Entry {
    pub id: u8,
    pub address: Option<String>,
    pub name: Option<String>,
    /// Its data sheet.
    pub eds: Option<PathBuf>,
    /// Its data sheet with values, and maybe with its serial number.
    pub dcf: Option<PathBuf>,
    #[serde(default)]
    pub values: toml::Table,
    /// Keys of others.
    #[serde(flatten)]
    pub others: toml::Table,
}

impl Entry {
    pub fn node_id(&self) -> Result<NodeId, String> {
        NodeId::new(self.id).ok_or_else(|| format!("{} is no node-ID", self.id))
    }

    pub fn lss_address(&self) -> Result<Option<Address>, String> {
        let Some(text) = &self.address else { return Ok(None) };
        address::address(text).map(Some).map_err(|why| format!("{text}: {why}"))
    }
}

impl Table {
    /// Reads the table; a file that does not exist is an empty one.
    pub fn read(path: &Path) -> Result<Self> {
        let wrong = |why: String| Failure::Refused(format!("{}: {why}", path.display()));
        let text = text(path).map_err(|error| wrong(error.to_string()))?;
        let content = parse(&text).map_err(wrong)?;
        let mut table = Self { path: path.to_owned(), entries: Vec::new(), ids: BTreeSet::new() };
        for entry in content.node {
            let id = entry.node_id().map_err(wrong)?;
            table.ids.insert(id.get());
            table.entries.extend(entry.lss_address().map_err(wrong)?.map(|address| (id, address)));
        }
        Ok(table)
    }

    /// The table with one more entry at its end, beside it. A board gets no node-ID that the table cannot keep.
    pub fn with(&self, id: NodeId, address: Address) -> Result<Draft> {
        self.draft(id, address, |text| {
            let text = text + &entry(id, address);
            // An array of inline tables, for example, does not go on at the end of the file.
            match parse(&text) {
                Ok(_) => Ok(text),
                Err(why) => Err(format!("with one more [[node]] at its end: {why}")),
            }
        })
    }

    /// The table with another board in the place of a node-ID, beside it.
    pub fn with_another(&self, id: NodeId, address: Address) -> Result<Draft> {
        self.draft(id, address, |text| {
            replaced(&text, id, &address).ok_or_else(|| format!("it has no node {id} any more"))
        })
    }

    fn draft(
        &self,
        id: NodeId,
        address: Address,
        change: impl FnOnce(String) -> Result<String, String>,
    ) -> Result<Draft> {
        let text = text(&self.path).map_err(|error| error.to_string());
        let draft = text.and_then(change).and_then(|text| {
            let draft = Draft::new(&self.path, id, address);
            match draft.write(&text) {
                Ok(()) => Ok(draft),
                Err(error) => Err(format!("cannot write: {}: {error}", draft.beside.display())),
            }
        });
        draft.map_err(|why| {
            Failure::Refused(format!(
                "{}: {why}. Board {address} got no node-ID",
                self.path.display()
            ))
        })
    }

    /// Puts the draft in the place of the table. The file is the old one or the new one at any time.
    pub fn take(&mut self, draft: &Draft) -> io::Result<()> {
        fs::rename(&draft.beside, &draft.file)?;
        self.entries.retain(|(id, _)| *id != draft.id);
        self.entries.push((draft.id, draft.address));
        self.ids.insert(draft.id.get());
        Ok(())
    }
}

/// A table with another content on the disk. It is removed unless it has taken the place of the table.
pub struct Draft {
    /// The file of the table, which a link may lead to.
    file: PathBuf,
    beside: PathBuf,
    id: NodeId,
    address: Address,
}

impl Draft {
    fn new(path: &Path, id: NodeId, address: Address) -> Self {
        let mut file = path.to_owned();
        while let Ok(to) = fs::read_link(&file) {
            file = file.parent().unwrap_or(Path::new("")).join(to);
        }
        let beside = beside(&file, ".new");
        Self { file, beside, id, address }
    }

    fn write(&self, text: &str) -> io::Result<()> {
        let mut new = File::create(&self.beside)?;
        new.write_all(text.as_bytes())?;
        if let Ok(old) = fs::metadata(&self.file) {
            new.set_permissions(old.permissions())?;
        }
        new.sync_all()
    }
}

impl Drop for Draft {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.beside);
    }
}

/// A file beside another one, with this behind its name.
pub fn beside(path: &Path, end: &str) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(end);
    path.with_file_name(name)
}

/// The text of the file; none if it does not exist.
fn text(path: &Path) -> io::Result<String> {
    match fs::read_to_string(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(String::new()),
        text => text,
    }
}

fn entry(id: NodeId, address: Address) -> String {
    format!("\n[[node]]\nid = {id}\naddress = \"{address}\"\n")
}

/// Reads the content, in which no node-ID and no address is wrong or given twice.
pub fn parse(text: &str) -> Result<Content, String> {
    let content: Content = toml::from_str(text).map_err(|error| error.to_string())?;
    let (mut ids, mut addresses) = (BTreeSet::new(), BTreeSet::new());
    for entry in &content.node {
        let id = entry.node_id()?.get();
        let address = entry.lss_address()?.map(|address| address.to_string());
        let is_new = address.as_ref().is_none_or(|address| addresses.insert(address.clone()));
        if !ids.insert(id) || !is_new {
            let address = address.map_or_else(String::new, |address| format!(" or {address}"));
            return Err(format!("node-ID {id}{address} is given twice"));
        }
    }
    Ok(content)
}

/// The text with another address for a node-ID; `None` if it does not have it.
fn replaced(text: &str, id: NodeId, board: &Address) -> Option<String> {
    let mut document: DocumentMut = text.parse().ok()?;
    let is_done = match document.get_mut("node")? {
        Item::ArrayOfTables(tables) => tables.iter_mut().any(|table| set(table, id, board)),
        Item::Value(Value::Array(array)) => {
            let mut tables = array.iter_mut().filter_map(Value::as_inline_table_mut);
            tables.any(|table| set(table, id, board))
        }
        _ => false,
    };
    is_done.then(|| document.to_string())
}

/// Sets the address of a table if it is that of the node-ID.
fn set(table: &mut dyn TableLike, id: NodeId, board: &Address) -> bool {
    if table.get("id").and_then(Item::as_integer) != Some(id.get().into()) {
        return false;
    }
    let Some(value) = table.get_mut("address").and_then(Item::as_value_mut) else { return false };
    // The comment behind it.
    let decor = value.decor().clone();
    *value = board.to_string().into();
    *value.decor_mut() = decor;
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_must_not_give_an_id_or_an_address_twice() {
        let node =
            |id: u8, address: &str| format!("[[node]]\nid = {id}\naddress = \"{address}\"\n");
        assert_eq!(parse("").map(|content| content.node.len()), Ok(0));
        let two = node(5, "1:2:3:4") + &node(6, "1:2:3:5");
        assert_eq!(parse(&two).map(|content| content.node.len()), Ok(2));
        for wrong in [
            node(5, "1:2:3:4") + &node(5, "1:2:3:5"),
            node(5, "1:2:3:4") + &node(6, "0x1:2:3:04"),
            node(0, "1:2:3:4"),
            node(5, "1:2:3"),
            "nodes = 1".into(),
        ] {
            assert!(parse(&wrong).is_err(), "{wrong}");
        }
    }

    const BOARD: Address =
        Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number: 0xFF };

    #[test]
    fn only_the_address_changes() {
        let five = NodeId::new(5).expect("a node-ID");
        let before = "# plant 3\n[[node]]\nid=7\naddress = \"1:2:3:4\"\n\n[[node]] # the pump\naddress = '1:2:3:5'   # left\n\
                      id = 5\nname = \"pump\"\n[node.values]\n2100 = 3\n# end\n";
        let after = before.replace("'1:2:3:5'", "\"00000001:00000002:00000003:000000FF\"");
        assert_eq!(replaced(before, five, &BOARD), Some(after));
        let inline = "node = [{ id = 5, address = \"1:2:3:5\" }, # one\n  { id = 6, address = \"1:2:3:6\" }]\n";
        let after = inline.replace("1:2:3:5", "00000001:00000002:00000003:000000FF");
        assert_eq!(replaced(inline, five, &BOARD), Some(after));
        for without in
            ["", "node = 5", "[[node]]\nid = 6\naddress = \"1:2:3:4\"", "[[node]]\nid = 5"]
        {
            assert_eq!(replaced(without, five, &BOARD), None, "{without}");
        }
    }
}
