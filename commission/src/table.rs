//! The table of a network, `network.toml`: which LSS address has which node-ID.

mod replace;

use std::{
    collections::BTreeSet,
    fs::{self, File},
    io::{self, ErrorKind, Write},
    path::{Path, PathBuf},
};

use canopen_node::{NodeId, lss::Address};
use serde::Deserialize;

use crate::{address, failure::Failure};

/// The table, and the file that it grows in.
pub struct Table {
    path: PathBuf,
    pub entries: Vec<(NodeId, Address)>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Content {
    #[serde(default)]
    node: Vec<Entry>,
}

#[derive(Deserialize)]
struct Entry {
    id: u8,
    address: String,
}

impl Table {
    /// Reads the table; a file that does not exist is an empty one.
    pub fn read(path: &Path) -> Result<Self, Failure> {
        let wrong = |why: String| Failure::Refused(format!("{}: {why}", path.display()));
        let text = match fs::read_to_string(path) {
            Err(error) if error.kind() == ErrorKind::NotFound => String::new(),
            text => text.map_err(|error| wrong(error.to_string()))?,
        };
        let entries = parse(&text).map_err(wrong)?;
        Ok(Self { path: path.to_owned(), entries })
    }

    /// Adds an entry at the end of the file, which otherwise stays as it is.
    pub fn add(&mut self, id: NodeId, address: Address) -> io::Result<()> {
        let mut file = File::options().append(true).create(true).open(&self.path)?;
        let text = address::text(&address);
        write!(file, "\n[[node]]\nid = {}\naddress = \"{text}\"\n", id.get())?;
        self.entries.push((id, address));
        Ok(())
    }
}

fn parse(text: &str) -> Result<Vec<(NodeId, Address)>, String> {
    let content: Content = toml::from_str(text).map_err(|error| error.to_string())?;
    let (mut ids, mut addresses) = (BTreeSet::new(), BTreeSet::new());
    let mut entries = Vec::new();
    for Entry { id, address } in content.node {
        let node_id = NodeId::new(id).ok_or_else(|| format!("{id} is no node-ID"))?;
        let parsed = address::address(&address).map_err(|why| format!("{address}: {why}"))?;
        if !ids.insert(id) || !addresses.insert(address::text(&parsed)) {
            return Err(format!("node-ID {id} or {address} is there twice"));
        }
        entries.push((node_id, parsed));
    }
    Ok(entries)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_must_not_give_an_id_or_an_address_twice() {
        let node =
            |id: u8, address: &str| format!("[[node]]\nid = {id}\naddress = \"{address}\"\n");
        assert_eq!(parse("").map(|entries| entries.len()), Ok(0));
        let two = node(5, "1:2:3:4") + &node(6, "1:2:3:5");
        assert_eq!(parse(&two).map(|entries| entries.len()), Ok(2));
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
}
