//! The values of a node: written if they differ, stored, checked after a reset, and then proven by a stamp.

use std::time::Duration;

use can_bus::{eds, sdo};
use canopen_node::{NodeId, lss::Address, nmt::State};

use super::{
    files::{Node, STAMP},
    found::{self, Change, Values},
};
use crate::{failure::Failure, network::board::reset, session::Session};

/// The value that stores all parameters, as it is written to 1010h.
const SAVE: &[u8] = b"save";
/// The wait for the answer to it: a board may erase flash.
const STORE_WAIT: Duration = Duration::from_secs(5);
/// The COB-ID of a PDO, of emergency messages: what it stands for is off.
const OFF: u32 = 1 << 31;
/// The COB-ID of SYNC: the node is its producer.
const PRODUCER: u32 = 1 << 30;

/// What was done with a node.
#[derive(Default)]
pub struct Done {
    pub written: usize,
    pub is_stored: bool,
    /// The node was reset, and has its values since then.
    pub is_verified: bool,
    /// The NMT state before the reset was operational.
    pub was_operational: bool,
}

/// Brings the node to the wished values. With `stores_again` they are stored in any case.
pub fn apply(
    session: &mut Session<'_>,
    id: NodeId,
    address: &Address,
    node: &Node,
    stores_again: bool,
    trusts_stamps: bool,
) -> Result<Done, Failure> {
    let values = found::values(session, id, node, trusts_stamps)?;
    let has_none = node.values.is_empty() && node.stamp.is_none();
    match values.are_as_wanted() {
        _ if has_none => Ok(Done::default()),
        true if !stores_again || !node.can_store() => Ok(Done::default()),
        // Nobody knows whether a run that was cut off has stored them, or their stamp.
        true => {
            store(session, id, node)?;
            Ok(Done { is_stored: true, ..Done::default() })
        }
        false => carry(session, id, address, node, &values),
    }
}

fn carry(
    session: &mut Session<'_>,
    id: NodeId,
    address: &Address,
    node: &Node,
    values: &Values,
) -> Result<Done, Failure> {
    write_all(session, id, node, values)?;
    let mut done = Done { written: values.changes.len(), ..Done::default() };
    if node.can_store() {
        store(session, id, node)?;
        (done.is_stored, done.is_verified) = (true, true);
        done.was_operational =
            session.bus.states.get(&id.get()) == Some(&(State::Operational as u8));
        session.progress.say(|| format!("{}: reset", node.words()));
        reset(session, id, address)?;
    }
    for Change { address, wanted, .. } in &values.changes {
        let Some(entry) = node.entry(*address).filter(|entry| entry.can_be_read()) else {
            continue;
        };
        let words = node.value_words(*address);
        let found = sdo::read(&mut session.bus, id.get(), address.0, address.1)?
            .map_err(|why| Failure::Refused(format!("{words}: {}", sdo::in_words(&why))))?;
        if !node.is_as_wanted(*address, &found) {
            let (found, wanted) = (entry.text(&found), entry.text(wanted));
            return Err(Failure::Refused(match done.is_stored {
                true => format!(
                    "{words} is {found} after a reset, and not {wanted}: the board does not store it. Take it out of the \
                     file"
                ),
                false => format!("{words} is {found}, although {wanted} was written"),
            }));
        }
    }
    // Only now, since it proves that the values are there after a reset.
    if let Some(stamp) = node.stamp {
        for (sub_index, number) in (1..).zip(stamp.numbers) {
            write(session, id, node, (STAMP, sub_index), &number.to_le_bytes())?;
        }
        store(session, id, node)?;
    }
    Ok(done)
}

/// Writes what differs: a PDO is off meanwhile, and its COB-ID comes last.
fn write_all(
    session: &mut Session<'_>,
    id: NodeId,
    node: &Node,
    values: &Values,
) -> Result<(), Failure> {
    // The number of a PDO, by its parameters or its mapping; by the index of its communication parameters.
    let pdo = |address: eds::Address| match address.0 {
        index @ (0x1400..=0x15FF | 0x1800..=0x19FF) => Some(index),
        index @ (0x1600..=0x17FF | 0x1A00..=0x1BFF) => Some(index - 0x200),
        _ => None,
    };
    let mut pdos: Vec<u16> =
        values.changes.iter().filter_map(|change| pdo(change.address)).collect();
    pdos.dedup();
    pdos.sort_unstable();
    pdos.dedup();
    let (count, mut number) = (values.changes.len(), 0);
    for change in values.changes.iter().filter(|change| pdo(change.address).is_none()) {
        number += 1;
        session.progress.say(|| format!("{}: writing value {number} of {count}", node.words()));
        write_change(session, id, node, change)?;
    }
    for index in pdos {
        let of_it = values.changes.iter().filter(|change| pdo(change.address) == Some(index));
        let changes: Vec<&Change> = of_it.collect();
        session.progress.say(|| format!("{}: PDO {index:04X}", node.words()));
        // Half a PDO would be on the bus otherwise.
        session.uninterrupted(|session| write_pdo(session, id, node, index, &changes))?;
    }
    Ok(())
}

/// Writes a value. A COB-ID that is in use is switched off first (CiA 301, 1005h and 1014h).
fn write_change(
    session: &mut Session<'_>,
    id: NodeId,
    node: &Node,
    change: &Change,
) -> Result<(), Failure> {
    let Change { address, found, wanted } = change;
    let off = match (address, found.as_deref().map(<[u8; 4]>::try_from)) {
        ((0x1014, 0), Some(Ok(found))) if u32::from_le_bytes(found) & OFF == 0 => {
            Some(u32::from_le_bytes(found) | OFF)
        }
        ((0x1005, 0), Some(Ok(found))) if u32::from_le_bytes(found) & PRODUCER != 0 => {
            Some(u32::from_le_bytes(found) & !PRODUCER)
        }
        _ => None,
    };
    if let Some(off) = off {
        write(session, id, node, *address, &off.to_le_bytes())?;
    }
    write(session, id, node, *address, wanted)
}

/// Writes what differs in a PDO with these communication parameters (CiA 301, 7.5.2.36 and 7.5.2.38).
fn write_pdo(
    session: &mut Session<'_>,
    id: NodeId,
    node: &Node,
    index: u16,
    changes: &[&Change],
) -> Result<(), Failure> {
    let cob_id = (index, 1);
    let mapping = index + 0x200;
    let Some(wanted) = node.values.get(&cob_id) else {
        // Neither mapping nor COB-ID are wished.
        for change in changes {
            write(session, id, node, change.address, &change.wanted)?;
        }
        return Ok(());
    };
    let mut steps: Vec<(eds::Address, Vec<u8>)> = Vec::new();
    let mut off: Vec<u8> = wanted.clone();
    if let Some(top) = off.last_mut() {
        *top |= 0x80;
    }
    steps.push((cob_id, off));
    let is_mapping = |change: &&&Change| change.address.0 == mapping;
    if changes.iter().any(|change| is_mapping(&change)) {
        steps.push(((mapping, 0), vec![0]));
        let mapped = node.values.range((mapping, 1)..=(mapping, 0xFF));
        let count = node.values.get(&(mapping, 0)).cloned().unwrap_or_default();
        // Those beyond the number of mapped objects need not exist.
        let is_used = |sub_index: u8| count.first().is_some_and(|count| sub_index <= *count);
        let used = mapped.filter(|(address, _)| is_used(address.1));
        steps.extend(used.map(|(address, bytes)| (*address, bytes.clone())));
        steps.push(((mapping, 0), count));
    }
    let others =
        changes.iter().filter(|change| change.address.0 == index && change.address != cob_id);
    steps.extend(others.map(|change| (change.address, change.wanted.clone())));
    steps.push((cob_id, wanted.clone()));
    for (address, bytes) in steps {
        write(session, id, node, address, &bytes)?;
    }
    Ok(())
}

fn store(session: &mut Session<'_>, id: NodeId, node: &Node) -> Result<(), Failure> {
    session.progress.say(|| format!("{}: storing", node.words()));
    write(session, id, node, (0x1010, 1), SAVE)
}

fn write(
    session: &mut Session<'_>,
    id: NodeId,
    node: &Node,
    address: eds::Address,
    bytes: &[u8],
) -> Result<(), Failure> {
    let outcome = sdo::download(&mut session.bus, id.get(), address, bytes, STORE_WAIT)?;
    let text = node.entry(address).map_or_else(String::new, |entry| entry.text(bytes));
    let words = |why: String| match address {
        (0x1010, _) => format!("it cannot store: {}", sdo::in_words(&why)),
        _ => format!("{} cannot be {text}: {}", node.value_words(address), sdo::in_words(&why)),
    };
    outcome.map_err(|why| Failure::Refused(words(why)))
}
