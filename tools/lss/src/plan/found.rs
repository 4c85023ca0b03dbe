//! Which board is where in the network.

use canopen_node::{
    BitRate, NodeId,
    lss::{Address, Request},
};
use lss_master::InquireNodeId;

use super::{files::Files, node::Node, sheet::Board};
use crate::{
    address,
    failure::{Failure, Result},
    network::{
        board::{self, Search},
        nodes::{self, Nodes},
        rate,
        rows::{self, Row},
    },
    session::{DEFAULT_RATE, Session},
};

/// Where a board is.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    pub address: Address,
    pub id: Option<NodeId>,
    /// Another board has the same node-ID: they answer to SDO together.
    pub is_shared: bool,
}

/// The boards on the bus.
#[derive(Default)]
pub struct Found {
    /// The nodes that answer.
    pub nodes: Nodes,
    /// By the number of the node in the files; `None` if it is missing.
    pub places: Vec<Option<Place>>,
    /// Boards that no file names.
    pub unknown: Vec<Row>,
    /// The boards without a node-ID are among them.
    pub is_scanned: bool,
    /// What is missing or not clear, in words.
    pub problems: Vec<String>,
    /// The values of the files that the boards do not get, and why.
    pub left_out: Vec<String>,
}

/// Opens the bus at the bit rate that the network has: `given` by the user, or that of the files. If a frame is heard
/// at only the other of them, it is that: an earlier run has switched the network, or none yet. Nothing is asked at a
/// bit rate that may be wrong but one question.
pub fn open(session: &mut Session, given: Option<BitRate>, wanted: Option<BitRate>) -> Result {
    let fixed = session.bus.fixed_rate();
    let mut rate = fixed.or(given).or(wanted).unwrap_or(DEFAULT_RATE);
    let other = match given {
        None => wanted.map(|_| DEFAULT_RATE),
        Some(_) => wanted,
    };
    if let Some(other) = other.filter(|other| fixed.is_none() && *other != rate) {
        match rate::heard_at(session, &[rate, other])? {
            Some(heard) => rate = heard,
            // What follows needs answers: to be acknowledged is enough here.
            None if rate::answers_at(session, rate)?.is_acknowledged => {}
            None => {
                return Err(Failure::NoAnswer(format!(
                    "nobody answers at {rate}, and no frame is heard at {rate} and {other}. If the boards are at {other}: \
                     --bit-rate {}",
                    other.kbit_per_s()
                )));
            }
        }
    }
    session.bus.open(rate)?;
    board::end_earlier_run(session)
}

/// The boards that have no place, by their numbers: they are missing, or something fails with them alone, in words.
pub type Absent = Vec<(usize, Option<String>)>;

/// Where these boards are, of which each is to have a node-ID, and is named by its LSS address or is looked for later: at
/// the node-ID, at that which it tells by SDO, or where LSS finds it. All boards are in LSS waiting state then.
pub fn places(
    session: &mut Session,
    nodes: Nodes,
    boards: &[(NodeId, Option<Address>)],
) -> Result<(Found, Absent)> {
    let named = boards.iter().filter_map(|(id, address)| Some((*id, (*address)?)));
    let known = nodes::known(session, &named.collect::<Vec<_>>(), &nodes)?;
    let mut rest = nodes.clone();
    rest.retain(|id, _| !known.contains(id));
    let mut rows = rows::of(session, rest)?;
    let problems = rows::twins(&rows);
    let mut search = Search::default();
    let (mut places, mut absent) = (vec![None; boards.len()], Vec::new());
    for (number, &(id, address)) in boards.iter().enumerate() {
        let Some(address) = address else { continue };
        session.progress.say(|| format!("looking for node {id}"));
        let row = rows.iter().position(|row| row.lss_address == Some(address));
        let place = match row.map(|row| rows.remove(row)) {
            _ if known.contains(&id.get()) => {
                Ok(Some(Place { address, id: Some(id), is_shared: false }))
            }
            Some(row) => Ok(place_of(&row)),
            // It has no node-ID, or is stopped, or does not tell its LSS address by SDO.
            None => select(session, &mut search, address),
        };
        match place {
            Ok(None) => absent.push((number, None)),
            Ok(place) => places[number] = place,
            Err(failure) => absent.push((number, Some(failure.of_board()?))),
        }
        if let Some(Place { id: Some(id), .. }) = places[number] {
            rows.retain(|row| row.lss_address.is_some() || row.node_id != Some(id.get()));
        }
    }
    session.bus.request(Request::SwitchToWaiting)?;
    Ok((Found { nodes, places, unknown: rows, problems, ..Found::default() }, absent))
}

/// Finds the boards of the files, and all others.
///
/// A Fastscan takes long if it finds boards that the files name. So unless the plan is all that is wanted (`is_plan`),
/// it waits until they have their node-IDs: [`late`].
pub fn boards(session: &mut Session, files: &Files, is_plan: bool) -> Result<Found> {
    let nodes = nodes::nodes(session)?;
    let boards: Vec<_> = files.nodes.iter().map(|node| (node.id, node.address())).collect();
    let (mut found, absent) = places(session, nodes, &boards)?;
    let Found { places, unknown, is_scanned, problems, .. } = &mut found;
    let is_blank = |place: &Option<Place>| place.is_some_and(|place| place.id.is_none());
    let is_clear = |node: &Node| node.address().is_some() || only(node, unknown).is_ok();
    *is_scanned = is_plan || !places.iter().any(is_blank) || !files.nodes.iter().all(is_clear);
    if *is_scanned {
        unknown.extend(others(session, places, problems)?);
    }
    for (node, place) in files.nodes.iter().zip(places) {
        if node.address().is_none() {
            match only(node, unknown) {
                Ok(row) => *place = place_of(&unknown.remove(row)),
                Err(why) => problems.push(why),
            }
        }
    }
    for (number, why) in absent {
        let node = &files.nodes[number];
        let words = node.words();
        problems.push(match (why, node.address()) {
            (None, Some(address)) => {
                let revision_number = address.revision_number;
                let is_it = |other| Address { revision_number, ..other } == address;
                let hint = other_revision(unknown, is_it);
                format!("{words} is missing: {address}. {hint}")
            }
            (why, _) => format!("{words}: {}", why.unwrap_or_default()),
        });
    }
    Ok(found)
}

/// The boards without a node-ID that no file names, if they have not been looked for before.
pub fn late(session: &mut Session, found: &mut Found) -> Result<Vec<Row>> {
    if found.is_scanned {
        return Ok(Vec::new());
    }
    found.is_scanned = true;
    others(session, &found.places, &mut found.problems)
}

/// The boards without a node-ID beside these.
fn others(
    session: &mut Session,
    places: &[Option<Place>],
    problems: &mut Vec<String>,
) -> Result<Vec<Row>> {
    let mut rows = rows::blank(session, problems)?;
    let known: Vec<Address> = places.iter().flatten().map(|place| place.address).collect();
    // One that tells its address by LSS alone, and is known by that.
    let has_blank = places.iter().flatten().any(|place| place.id.is_none());
    rows.retain(|row| match row.lss_address {
        Some(address) => !known.contains(&address),
        None => !has_blank,
    });
    Ok(rows)
}

impl Found {
    /// Notes values that a board does not get, once.
    pub fn leave_out(&mut self, node: &Node, values: &[String]) {
        let words = values.iter().map(|words| format!("{}: left out: {words}", node.words()));
        let new: Vec<String> = words.filter(|words| !self.left_out.contains(words)).collect();
        self.left_out.extend(new);
    }

    /// The places of boards that share a node-ID with another are known to be alone after a further look.
    pub fn unshare(&mut self) {
        let places: Vec<Place> = self.places.iter().flatten().copied().collect();
        let unknown: Vec<u8> = self.unknown.iter().filter_map(|row| row.node_id).collect();
        for place in self.places.iter_mut().flatten() {
            let Some(id) = place.id else { continue };
            let count = places.iter().filter(|other| other.id == Some(id)).count();
            place.is_shared = count > 1 || unknown.contains(&id.get());
        }
    }
}

/// What to do if a board is missing: one that `is_it` but for its revision number may be on the bus.
fn other_revision(rows: &[Row], is_it: impl Fn(Address) -> bool) -> String {
    let mut boards = rows.iter().filter_map(|row| row.lss_address);
    match boards.find(|address| is_it(*address)) {
        Some(board) => format!(
            "But {board} answers, with another revision number: if it is the one, write that into the file"
        ),
        None => "Is it on the bus, and has it power?".into(),
    }
}

fn place_of(row: &Row) -> Option<Place> {
    let id = row.node_id.and_then(NodeId::new);
    Some(Place { address: row.lss_address?, id, is_shared: row.is_duplicate })
}

fn select(session: &mut Session, search: &mut Search, address: Address) -> Result<Option<Place>> {
    if !search.select(session, address)? {
        return Ok(None);
    }
    let id = session.carry_out(InquireNodeId)?;
    Ok(Some(Place { address, id, is_shared: false }))
}

/// The row of the board that is meant by its kind alone: the one that has the node-ID, or the only one.
fn only(node: &Node, rows: &[Row]) -> Result<usize, String> {
    let Board::Kind(kind) = node.board else { return Err(String::new()) };
    let is_it = |row: &Row| row.lss_address.is_some_and(|address| address::is_of(&address, kind));
    let all: Vec<usize> = (0..rows.len()).filter(|row| is_it(&rows[*row])).collect();
    let has_id =
        |row: &&usize| rows[**row].node_id == Some(node.id.get()) && !rows[**row].is_duplicate;
    if let Some(row) = all.iter().find(has_id) {
        return Ok(*row);
    }
    match all[..] {
        [row] => Ok(row),
        [] => Err(format!(
            "{} is missing: no board {} answers. {}",
            node.words(),
            address::kind_text(&kind),
            other_revision(rows, |other| address::is_of(&other, [kind[0], kind[1], None, kind[3]]))
        )),
        _ => Err(format!(
            "{} may be each of {} boards, {}: say which one, by address = \"...\" in a table or LSS_SerialNumber in \
                 the DCF",
            node.words(),
            all.len(),
            address::list(all.iter().filter_map(|row| rows[*row].lss_address))
        )),
    }
}
