//! The plan: per board what is there and what it will be, as text and as JSON.

use canopen_node::{BitRate, NodeId};
use serde::Serialize;

use super::{
    files::Files,
    found::{Found, Place},
    node::Node,
    values::{Change, Values},
};
use crate::{
    address::{counted, id_text},
    failure::Result,
    network::rows::Row,
    session::Session,
};

/// What differs in a network.
#[derive(Serialize)]
pub struct Plan {
    bit_rate: Difference<u16>,
    nodes: Vec<NodePlan>,
    /// The boards that no file names. They stay as they are.
    unknown: Vec<Row>,
    problems: Vec<String>,
    /// Whether there is something to do.
    differs: bool,
}

#[derive(Serialize)]
struct Difference<T> {
    found: T,
    wanted: T,
}

#[derive(Serialize)]
struct NodePlan {
    #[serde(skip)]
    words: String,
    name: Option<String>,
    lss_address: Option<String>,
    is_missing: bool,
    node_id: Difference<Option<u8>>,
    /// The values that differ; all if they can be compared only once the board has its node-ID.
    values: Vec<ValuePlan>,
    are_values_compared: bool,
    lacks_stamp: bool,
    stores_again: bool,
    differs: bool,
}

#[derive(Serialize)]
struct ValuePlan {
    #[serde(skip)]
    words: String,
    index: u16,
    sub_index: u8,
    name: String,
    /// `None`: it cannot be read, or not yet.
    found: Option<String>,
    wanted: String,
}

impl Plan {
    /// The plan for these boards and their values. With `stores_again` all
    /// boards store, since an earlier run did not finish.
    pub fn new(
        files: &Files,
        found: &Found,
        values: &[Values],
        rate: BitRate,
        stores_again: bool,
    ) -> Self {
        let nodes: Vec<NodePlan> = files
            .nodes
            .iter()
            .zip(&found.places)
            .zip(values)
            .map(|((node, place), values)| NodePlan::new(node, *place, values, stores_again))
            .collect();
        let bit_rate = Difference {
            found: rate.kbit_per_s(),
            wanted: files.bit_rate.unwrap_or(rate).kbit_per_s(),
        };
        Self {
            differs: bit_rate.found != bit_rate.wanted || nodes.iter().any(|node| node.differs),
            bit_rate,
            nodes,
            unknown: found.unknown.clone(),
            problems: found.problems.iter().chain(&found.left_out).cloned().collect(),
        }
    }

    pub fn differs(&self) -> bool {
        self.differs
    }

    /// `2 of 3 boards`.
    pub fn count(&self) -> String {
        let changed = self.nodes.iter().filter(|node| node.differs).count();
        format!("{changed} of {}", counted(self.nodes.len(), "board"))
    }

    pub fn print(&self, session: &mut Session) -> Result {
        let out = &mut *session.out;
        let Difference { found, wanted } = self.bit_rate;
        match found == wanted {
            true => writeln!(out, "  bit rate: {found} kbit/s")?,
            false => {
                writeln!(out, "~ bit rate: {found} -> {wanted} kbit/s, of all boards on the bus")?
            }
        }
        for node in &self.nodes {
            node.print(out)?;
        }
        for row in &self.unknown {
            print_unknown(out, row)?;
        }
        for problem in &self.problems {
            writeln!(out, "! {problem}")?;
        }
        let changed =
            |is_it: fn(&NodePlan) -> bool| self.nodes.iter().filter(|node| is_it(node)).count();
        let values: usize = self.nodes.iter().map(|node| node.values.len()).sum();
        writeln!(
            out,
            "plan: {} change, {} missing; {}, {}",
            self.count(),
            changed(|node| node.is_missing),
            counted(
                changed(|node| !node.is_missing && node.node_id.found != node.node_id.wanted),
                "node-ID"
            ),
            counted(values, "value"),
        )?;
        Ok(())
    }
}

/// A board that no file names.
pub fn print_unknown(out: &mut dyn std::io::Write, row: &Row) -> std::io::Result<()> {
    let (address, id) = (row.address_text(), id_text(row.node_id.and_then(NodeId::new)));
    writeln!(out, "? {address}  node-ID {id}, not in the files: it stays as it is")
}

impl NodePlan {
    fn new(node: &Node, place: Option<Place>, values: &Values, stores_again: bool) -> Self {
        let found = place.and_then(|place| place.id).map(NodeId::get);
        let node_id = Difference { found, wanted: Some(node.id.get()) };
        let value = |change: &Change| {
            let Change { address: (index, sub_index), found, wanted } = change;
            let words = node.value_words(change.address);
            let text = |bytes: &Vec<u8>| {
                node.entry(change.address).map_or_else(String::new, |entry| entry.text(bytes))
            };
            ValuePlan {
                name: words.split_once(' ').map_or("", |(_, name)| name).to_owned(),
                words,
                index: *index,
                sub_index: *sub_index,
                found: found.as_ref().map(text),
                wanted: text(wanted),
            }
        };
        let is_missing = place.is_none();
        Self {
            words: node.words(),
            name: node.name.clone(),
            lss_address: place.map(|place| place.address.to_string()),
            is_missing,
            differs: !is_missing
                && (stores_again || node_id.found != node_id.wanted || !values.are_as_wanted()),
            node_id,
            // Those of a missing board are not its plan.
            values: values.changes.iter().filter(|_| !is_missing).map(value).collect(),
            are_values_compared: values.are_compared,
            lacks_stamp: values.lacks_stamp,
            stores_again,
        }
    }

    fn print(&self, out: &mut dyn std::io::Write) -> std::io::Result<()> {
        let Some(address) = &self.lss_address else { return Ok(()) };
        let sign = if self.differs { '~' } else { ' ' };
        let no_change = if self.differs { "" } else { "  no change" };
        writeln!(out, "{sign} {}  {address}{no_change}", self.words)?;
        let Difference { found, wanted } = self.node_id;
        if found != wanted {
            let text = |id: Option<u8>| id_text(id.and_then(NodeId::new));
            writeln!(out, "    ~ node-ID: {} -> {}", text(found), text(wanted))?;
        }
        if self.stores_again {
            writeln!(out, "    ~ stores again, since an earlier run did not finish")?;
        }
        if !self.are_values_compared && !self.values.is_empty() {
            let count = counted(self.values.len(), "value");
            writeln!(out, "    ~ {count} to compare once it has its node-ID:")?;
        }
        for ValuePlan { words, found, wanted, .. } in &self.values {
            let each_time = match found.is_none() && self.are_values_compared {
                true => ", each time: it can only be written",
                false => "",
            };
            let found = found.as_deref().unwrap_or("?");
            writeln!(out, "    ~ {words}: {found} -> {wanted}{each_time}")?;
        }
        if self.lacks_stamp && self.values.is_empty() {
            writeln!(out, "    ~ it has the values; stores them, and the stamp that proves it")?;
        }
        Ok(())
    }
}
