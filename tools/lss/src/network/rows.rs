//! What is known about each board: a row for each, with and without a node-ID.

use can_bus::{explain::nmt_state, sdo};
use canopen_node::{NodeId, lss::Address};
use serde::{Serialize, Serializer};

use super::{
    nodes::{self, Nodes},
    rate::HEARTBEAT,
    scan,
};
use crate::{
    failure::{Failure, Result},
    session::Session,
};

/// A node, as far as it is known.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Row {
    pub node_id: Option<u8>,
    #[serde(serialize_with = "as_text")]
    pub lss_address: Option<Address>,
    /// Object 1008h.
    pub name: Option<String>,
    /// Object 100Ah.
    pub version: Option<String>,
    /// The NMT state, if the node sends a heartbeat.
    pub state: Option<&'static str>,
    /// Another node has the same node-ID.
    pub is_duplicate: bool,
    /// In kbit/s: that of the adapter, at which the node answers.
    pub bit_rate: u16,
    /// In kbit/s: object 2000h of this repository's nodes, the bit rate that the node begins with at its next start.
    pub home_bit_rate: Option<u16>,
}

impl Row {
    pub fn id_text(&self) -> String {
        match (self.node_id, self.is_duplicate) {
            (None, _) => "none".into(),
            (Some(id), false) => id.to_string(),
            (Some(id), true) => format!("{id} twice"),
        }
    }

    /// The LSS address, or a dash.
    pub fn address_text(&self) -> String {
        self.lss_address.map_or("-".into(), |address| address.to_string())
    }

    /// The board, for a sentence.
    pub fn words(&self) -> String {
        self.node_id.map_or("a board without a node-ID".into(), |id| format!("node {id}"))
    }

    /// The bit rate, and that of the next start if it is another.
    pub fn bit_rate_text(&self) -> String {
        match self.home_bit_rate {
            // 0: it is detected.
            Some(home) if home != 0 && home != self.bit_rate => {
                format!("{} (home {home})", self.bit_rate)
            }
            _ => self.bit_rate.to_string(),
        }
    }
}

fn as_text<S: Serializer>(address: &Option<Address>, serializer: S) -> Result<S::Ok, S::Error> {
    address.map(|address| address.to_string()).serialize(serializer)
}

/// The words for each pair of boards with one LSS address: the second row follows the first.
pub fn twins(rows: &[Row]) -> Vec<String> {
    let twins = rows.windows(2).filter_map(|pair| {
        let (id, address) = (pair[0].node_id?, pair[0].lss_address?);
        let is_twin = (pair[1].node_id, pair[1].lss_address) == (Some(id), Some(address));
        is_twin.then(|| nodes::two(address, id))
    });
    twins.collect()
}

/// All nodes: those with a node-ID by SDO, or as far as they were heard; the others by Fastscan. No state is changed.
/// What is not clear comes to the `problems`, in words.
pub fn rows(session: &mut Session, problems: &mut Vec<String>) -> Result<Vec<Row>> {
    let nodes = nodes::nodes(session)?;
    let mut rows = of(session, nodes)?;
    rows.extend(blank(session, problems)?);
    if rows.is_empty() {
        session.bus.pass(HEARTBEAT)?;
    }
    for &id in session.bus.heard.keys() {
        if rows.iter().all(|row| row.node_id != Some(id)) {
            let state = heard_state(session, id);
            let bit_rate = session.bus.rate().kbit_per_s();
            rows.push(Row { node_id: Some(id), state, bit_rate, ..Row::default() });
        }
    }
    rows.sort_by_key(|row| (row.node_id.is_none(), row.node_id));
    Ok(rows)
}

/// Those of nodes that answer.
pub fn of(session: &mut Session, nodes: Nodes) -> Result<Vec<Row>> {
    let mut rows = Vec::new();
    for (id, serial_numbers) in nodes {
        session.progress.say(|| format!("reading the identity of node {id}"));
        rows.extend(node(session, id, &serial_numbers)?);
    }
    Ok(rows)
}

/// Those of the boards without a node-ID.
pub fn blank(session: &mut Session, problems: &mut Vec<String>) -> Result<Vec<Row>> {
    let bit_rate = session.bus.rate().kbit_per_s();
    let mut rows = Vec::new();
    let blank = scan::blank(session, problems)?;
    if blank.is_empty() && scan::is_anyone_without_fastscan(session)? {
        rows.push(Row { bit_rate, ..Row::default() });
    }
    for address in blank {
        let node_id = inquired(session, address).or_else(|failure| {
            problems.push(format!("board {address}: {}", failure.of_board()?));
            Ok::<_, Failure>(None)
        })?;
        rows.push(Row {
            node_id: node_id.map(NodeId::get),
            lss_address: Some(address),
            bit_rate,
            ..Row::default()
        });
    }
    Ok(rows)
}

/// The node-ID of a board that Fastscan has found. Frames may be lost.
fn inquired(session: &mut Session, address: Address) -> Result<Option<NodeId>> {
    let mut outcome = session.select(address);
    for _ in 0..2 {
        if let Err(Failure::NoAnswer(_)) = outcome {
            outcome = session.select(address);
        }
    }
    outcome
}

/// The NMT state that a node has reported.
pub fn heard_state(session: &Session, id: u8) -> Option<&'static str> {
    session.bus.heard.get(&id).copied().flatten().map(nmt_state)
}

/// The rows of a node-ID: one, or one for each node that has it.
pub fn node(session: &mut Session, id: u8, serial_numbers: &[u32]) -> Result<Vec<Row>> {
    let is_duplicate = serial_numbers.len() > 1;
    let mut numbers = [None; 3];
    for (number, sub_index) in numbers.iter_mut().zip(1..) {
        *number = match is_duplicate {
            // Each of them may answer. If they differ, it is not known which answer is whose.
            true => match nodes::answers_of(session, id, sub_index)?[..] {
                [one, ref others @ ..] if others.iter().all(|other| *other == one) => Some(one),
                _ => None,
            },
            false => sdo::read_number(&mut session.bus, id, 0x1018, sub_index)?.ok(),
        };
    }
    let mut text = |index| -> Result<Option<String>> {
        // Two nodes that answer together spoil a transfer in segments.
        if is_duplicate {
            return Ok(None);
        }
        let value = sdo::read(&mut session.bus, id, index, 0)?.ok();
        Ok(value.map(|bytes| String::from_utf8_lossy(&bytes).trim_end_matches('\0').to_owned()))
    };
    let (name, version) = (text(0x1008)?, text(0x100A)?);
    let state = heard_state(session, id);
    let bit_rate = session.bus.rate().kbit_per_s();
    let home_bit_rate = home_bit_rate(session, id)?;
    let row = |serial_number: &u32| {
        // A node that does not tell a part has no LSS address that it could be selected by.
        let address = match (numbers, *serial_number) {
            ([Some(vendor), Some(product), Some(revision)], serial @ 1..) => {
                Some(Address::from([vendor, product, revision, serial]))
            }
            _ => None,
        };
        Row {
            node_id: Some(id),
            lss_address: address,
            name: name.clone(),
            version: version.clone(),
            state,
            is_duplicate,
            bit_rate,
            home_bit_rate,
        }
    };
    Ok(serial_numbers.iter().map(row).collect())
}

/// Object 2000h sub 5 of this repository's nodes. On another node that object is anything: there the bit rate in use,
/// sub 6, is not the adapter's.
pub fn home_bit_rate(session: &mut Session, id: u8) -> Result<Option<u16>> {
    let Ok(in_use) = sdo::read(&mut session.bus, id, 0x2000, 6)? else { return Ok(None) };
    if in_use != session.bus.rate().kbit_per_s().to_le_bytes() {
        return Ok(None);
    }
    let home = sdo::read(&mut session.bus, id, 0x2000, 5)?.ok();
    Ok(home.and_then(|bytes| Some(u16::from_le_bytes(bytes.try_into().ok()?))))
}
