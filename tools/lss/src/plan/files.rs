//! What the files of the user say about a network: its bit rate, and which board has which node-ID and which values.

use std::{
    fs,
    path::{Path, PathBuf},
};

use can_bus::{adapter, eds::Eds};
use canopen_node::{BitRate, NodeId};

use super::{
    node::{Node, Source},
    sheet::Sheet,
    table,
};
use crate::failure::{Failure, Result};

/// A network as it is wanted.
#[derive(Default)]
pub struct Files {
    pub bit_rate: Option<BitRate>,
    pub nodes: Vec<Node>,
}

impl Files {
    /// Reads tables (`.toml`), configuration files of devices (`.dcf`) and lists of nodes (`.cpj`).
    pub fn read(paths: &[PathBuf]) -> Result<Self> {
        let mut files = Self::default();
        let mut problems = Vec::new();
        for path in paths {
            let mut whys = Vec::new();
            let outcome = files.add(path, &mut whys);
            whys.extend(outcome.err());
            problems.extend(whys.into_iter().map(|why| format!("{}: {why}", path.display())));
        }
        if problems.is_empty() && files.nodes.is_empty() {
            problems.push("there is no node in the file".into());
        }
        problems.extend(files.contradictions());
        Failure::of(&problems).map(|()| files)
    }

    fn add(&mut self, path: &Path, problems: &mut Vec<String>) -> Result<(), String> {
        let extension = path.extension().and_then(|extension| extension.to_str());
        match extension.map(str::to_lowercase).as_deref() {
            Some("toml") => self.add_table(path, problems),
            Some("dcf") => {
                let sheet = Sheet::read(path)?;
                self.add_node(sheet.node_id()?, Ok(Source::dcf(sheet)), problems);
                Ok(())
            }
            Some("cpj") => self.add_list(path, problems),
            Some("eds") => {
                let name = path.file_name().unwrap_or_default().display();
                Err(format!(
                    "a data sheet is of no node. Name it in a table (network.toml): id = 5, address = \"V:P:R:S\", eds = \"{name}\""
                ))
            }
            _ => Err("its name must end with .toml, .dcf or .cpj".into()),
        }
    }

    fn add_table(&mut self, path: &Path, problems: &mut Vec<String>) -> Result<(), String> {
        let text = fs::read_to_string(path).map_err(|error| error.to_string())?;
        let content = table::parse(&text)?;
        let folder = path.parent().unwrap_or(Path::new("."));
        if let Some(rate) = content.bit_rate {
            let rate = adapter::bit_rate(&rate.to_string());
            problems.extend(rate.and_then(|rate| self.set_bit_rate(rate)).err());
        }
        for entry in content.node {
            let id = entry.node_id()?;
            for key in entry.others.keys() {
                problems.push(format!(
                    "node {id}: \"{key}\" is no key of a node: id, address, name, eds, dcf and values are"
                ));
            }
            let has_values = entry.dcf.is_some();
            let sheet = match (&entry.eds, &entry.dcf) {
                (Some(_), Some(_)) => Err("a DCF is a data sheet too: take eds away".into()),
                (eds, dcf) => {
                    let file = eds.as_ref().or(dcf.as_ref());
                    file.map(|file| Sheet::read(&folder.join(file))).transpose()
                }
            };
            let address = entry.lss_address()?;
            let (name, values) = (entry.name, entry.values);
            let source = sheet.map(|sheet| Source { address, name, has_values, sheet, values });
            self.add_node(id, source, problems);
        }
        Ok(())
    }

    /// A list of nodes with their configuration files (CiA 306): the first network of it.
    fn add_list(&mut self, path: &Path, problems: &mut Vec<String>) -> Result<(), String> {
        let list = Eds::read(path)?;
        let topology = list.section("Topology").ok_or("there is no [Topology] in it")?;
        let folder = path.parent().unwrap_or(Path::new("."));
        for id in (1..=127).filter_map(NodeId::new) {
            let key = |kind: &str| format!("node{id}{kind}");
            if list.number("Topology", &key("Present")).unwrap_or(0) == 0 {
                continue;
            }
            let source = match topology.get(&key("dcfname")).filter(|name| !name.is_empty()) {
                // A tool on Windows writes the path with its own separators.
                Some(file) => Sheet::read(&folder.join(file.replace('\\', "/"))),
                None => Err(format!("Node{id}DCFName is missing")),
            };
            let name = topology.get(&key("name")).cloned();
            let source = source.map(|sheet| Source { name, ..Source::dcf(sheet) });
            self.add_node(id, source, problems);
        }
        Ok(())
    }

    fn set_bit_rate(&mut self, rate: BitRate) -> Result<(), String> {
        match self.bit_rate.replace(rate) {
            Some(other) if other != rate => {
                Err(format!("{rate} here, but {other} before: a network has one bit rate"))
            }
            _ => Ok(()),
        }
    }

    fn add_node(&mut self, id: NodeId, source: Result<Source, String>, problems: &mut Vec<String>) {
        let mut whys = Vec::new();
        match source {
            Ok(source) => {
                match source.bit_rate() {
                    Ok(rate) => whys.extend(rate.and_then(|rate| self.set_bit_rate(rate).err())),
                    Err(why) => whys.push(why),
                }
                self.nodes.extend(source.node(id, &mut whys));
            }
            Err(why) => whys.push(why),
        }
        problems.extend(whys.into_iter().map(|why| format!("node {id}: {why}")));
    }

    /// What several files say differently, and rates that a board does not have.
    fn contradictions(&self) -> Vec<String> {
        let mut problems = Vec::new();
        for (number, node) in self.nodes.iter().enumerate() {
            for other in &self.nodes[..number] {
                if other.id == node.id {
                    problems.push(format!("node-ID {} is given twice", node.id));
                }
                if node.address().is_some() && node.board == other.board {
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
