//! The values of a node: compared with the wanted ones, written if they differ, stored, checked after a reset, and then
//! proven by a stamp.

use std::{collections::BTreeSet, time::Duration};

use can_bus::{eds, sdo};
use canopen_node::{NodeId, lss::Address, nmt::State};

use super::node::{Node, STAMP};
use crate::{failure::Failure, network::board::reset, session::Session};

/// The value that stores all parameters, as it is written to 1010h.
const SAVE: &[u8] = b"save";
/// The wait for the answer to it: a board may erase flash.
const STORE_WAIT: Duration = Duration::from_secs(5);
/// The COB-ID of a PDO, of emergency messages: what it stands for is off.
const OFF: u32 = 1 << 31;
/// The COB-ID of SYNC: the node is its producer.
const PRODUCER: u32 = 1 << 30;

/// A value that is not as it must be.
#[derive(Clone, Debug)]
pub struct Change {
    pub address: eds::Address,
    /// `None`: it cannot be read.
    pub found: Option<Vec<u8>>,
    pub wanted: Vec<u8>,
}

impl Change {
    /// Whether the change remains when the board gets its node-ID. A value that is the default for the node-ID that it
    /// has `now` follows.
    pub fn remains(&mut self, node: &Node, now: NodeId) -> bool {
        let default = |id: NodeId| node.entry(self.address)?.default(id.get());
        if self.found.is_some() && self.found == default(now) {
            self.found = default(node.id);
        }
        !self.found.as_ref().is_some_and(|found| node.is_as_wanted(self.address, found))
    }
}

/// The values of a node.
#[derive(Clone, Debug, Default)]
pub struct Values {
    /// They are those that differ, and not all, since they cannot be read yet.
    pub are_compared: bool,
    pub changes: Vec<Change>,
    /// The stamp is another one, or there is none where one must be.
    pub lacks_stamp: bool,
}

impl Values {
    /// Those of a node that cannot be asked.
    pub fn not_compared(node: &Node) -> Self {
        let change = |(address, wanted): (&eds::Address, &Vec<u8>)| Change {
            address: *address,
            found: None,
            wanted: wanted.clone(),
        };
        Self { changes: node.values.iter().map(change).collect(), ..Self::default() }
    }

    pub fn are_as_wanted(&self) -> bool {
        self.changes.is_empty() && !self.lacks_stamp
    }
}

/// Compares the values of the node with this node-ID with the wanted ones: by its stamp alone, if that proves them and
/// `trusts_stamp`.
pub fn compare(
    session: &mut Session<'_>,
    id: NodeId,
    node: &Node,
    trusts_stamp: bool,
) -> Result<Values, Failure> {
    let mut values = Values { are_compared: true, ..Values::default() };
    if let Some(stamp) = node.stamp {
        for (sub_index, number) in (1..).zip(stamp.numbers) {
            let found = sdo::read_number(&mut session.bus, id.get(), STAMP, sub_index)?
                .map_err(|why| unreadable(node, (STAMP, sub_index), &why))?;
            if found != number {
                values.lacks_stamp = true;
                break;
            }
        }
        if stamp.is_proof && trusts_stamp && !values.lacks_stamp {
            return Ok(values);
        }
    }
    for (count, (address, wanted)) in node.values.iter().enumerate() {
        session.progress.say(|| {
            format!("{}: reading value {} of {}", node.words(), count + 1, node.values.len())
        });
        let entry = node.entry(*address);
        let found = match entry.is_some_and(|entry| entry.can_be_read()) {
            false => None,
            true => Some(
                sdo::read(&mut session.bus, id.get(), address.0, address.1)?
                    .map_err(|why| unreadable(node, *address, &why))?,
            ),
        };
        if !found.as_ref().is_some_and(|found| node.is_as_wanted(*address, found)) {
            values.changes.push(Change { address: *address, found, wanted: wanted.clone() });
        }
    }
    Ok(values)
}

fn unreadable(node: &Node, address: eds::Address, why: &str) -> Failure {
    let words = sdo::in_words(why);
    let hint = match why {
        "no answer" => ". Is the node stopped (NMT)? `lss list` shows it",
        _ => ". Is it the data sheet of this board?",
    };
    Failure::Refused(format!("{} cannot be read: {words}{hint}", node.value_words(address)))
}

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

/// Brings the node to the wanted values. With `stores_again` they are stored in any case.
pub fn apply(
    session: &mut Session<'_>,
    id: NodeId,
    address: &Address,
    node: &Node,
    stores_again: bool,
    trusts_stamps: bool,
) -> Result<Done, Failure> {
    let values = compare(session, id, node, trusts_stamps)?;
    let has_none = node.values.is_empty() && node.stamp.is_none();
    let mut target = Target { session, id, node };
    match values.are_as_wanted() {
        _ if has_none => Ok(Done::default()),
        true if !stores_again || !node.can_store() => Ok(Done::default()),
        // Nobody knows whether a run that was cut off has stored them, or their stamp.
        true => {
            target.store()?;
            Ok(Done { is_stored: true, ..Done::default() })
        }
        false => target.change(address, &values.changes),
    }
}

/// A node whose values change.
struct Target<'s, 'a> {
    session: &'s mut Session<'a>,
    id: NodeId,
    node: &'s Node,
}

impl Target<'_, '_> {
    fn change(&mut self, address: &Address, changes: &[Change]) -> Result<Done, Failure> {
        self.write_all(changes)?;
        let node = self.node;
        let mut done = Done { written: changes.len(), ..Done::default() };
        if node.can_store() {
            self.store()?;
            (done.is_stored, done.is_verified) = (true, true);
            let state = self.session.bus.states.get(&self.id.get());
            done.was_operational = state == Some(&(State::Operational as u8));
            self.session.progress.say(|| format!("{}: reset", node.words()));
            reset(self.session, self.id, address)?;
        }
        for Change { address, wanted, .. } in changes {
            let Some(entry) = node.entry(*address).filter(|entry| entry.can_be_read()) else {
                continue;
            };
            let words = node.value_words(*address);
            let found = sdo::read(&mut self.session.bus, self.id.get(), address.0, address.1)?
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
                self.write((STAMP, sub_index), &number.to_le_bytes())?;
            }
            self.store()?;
        }
        Ok(done)
    }

    /// Writes what differs: a PDO is off meanwhile, and its COB-ID comes last.
    fn write_all(&mut self, changes: &[Change]) -> Result<(), Failure> {
        // A PDO by the index of its communication parameters.
        let pdo = |change: &Change| match change.address.0 {
            index @ (0x1400..=0x15FF | 0x1800..=0x19FF) => Some(index),
            index @ (0x1600..=0x17FF | 0x1A00..=0x1BFF) => Some(index - 0x200),
            _ => None,
        };
        let node = self.node;
        let others = changes.iter().filter(|change| pdo(change).is_none());
        for (number, change) in (1..).zip(others) {
            let count = changes.len();
            self.session
                .progress
                .say(|| format!("{}: writing value {number} of {count}", node.words()));
            self.write_change(change)?;
        }
        for index in changes.iter().filter_map(pdo).collect::<BTreeSet<u16>>() {
            let of_it = changes.iter().filter(|change| pdo(change) == Some(index));
            let changes: Vec<&Change> = of_it.collect();
            self.session.progress.say(|| format!("{}: PDO {index:04X}", node.words()));
            // Half a PDO would be on the bus otherwise.
            let id = self.id;
            self.session
                .uninterrupted(|session| Target { session, id, node }.write_pdo(index, &changes))?;
        }
        Ok(())
    }

    /// Writes a value. A COB-ID that is in use is switched off first (CiA 301, 1005h and 1014h).
    fn write_change(&mut self, change: &Change) -> Result<(), Failure> {
        let Change { address, found, wanted } = change;
        let found = found.as_deref().and_then(|found| found.try_into().ok());
        let off = match (address, found.map(u32::from_le_bytes)) {
            ((0x1014, 0), Some(found)) if found & OFF == 0 => Some(found | OFF),
            ((0x1005, 0), Some(found)) if found & PRODUCER != 0 => Some(found & !PRODUCER),
            _ => None,
        };
        if let Some(off) = off {
            self.write(*address, &off.to_le_bytes())?;
        }
        self.write(*address, wanted)
    }

    /// Writes what differs in a PDO with these communication parameters (CiA 301, 7.5.2.36 and 7.5.2.38).
    fn write_pdo(&mut self, index: u16, changes: &[&Change]) -> Result<(), Failure> {
        let node = self.node;
        let cob_id = (index, 1);
        let mapping = index + 0x200;
        let Some(wanted) = node.values.get(&cob_id) else {
            // Neither mapping nor COB-ID are wanted.
            return changes
                .iter()
                .try_for_each(|change| self.write(change.address, &change.wanted));
        };
        let mut off = wanted.clone();
        if let Some(top) = off.last_mut() {
            *top |= 0x80;
        }
        self.write(cob_id, &off)?;
        if changes.iter().any(|change| change.address.0 == mapping) {
            self.write((mapping, 0), &[0])?;
            let count = node.values.get(&(mapping, 0)).cloned().unwrap_or_default();
            // Those beyond the number of mapped objects need not exist.
            let last = count.first().copied().unwrap_or(0);
            let mapped = node.values.range((mapping, 1)..=(mapping, 0xFF));
            for (address, bytes) in mapped.take_while(|(address, _)| address.1 <= last) {
                self.write(*address, bytes)?;
            }
            self.write((mapping, 0), &count)?;
        }
        for change in changes {
            if change.address.0 == index && change.address != cob_id {
                self.write(change.address, &change.wanted)?;
            }
        }
        self.write(cob_id, wanted)
    }

    fn store(&mut self) -> Result<(), Failure> {
        let node = self.node;
        self.session.progress.say(|| format!("{}: storing", node.words()));
        self.write((0x1010, 1), SAVE)
    }

    fn write(&mut self, address: eds::Address, bytes: &[u8]) -> Result<(), Failure> {
        let bus = &mut self.session.bus;
        sdo::download(bus, self.id.get(), address, bytes, STORE_WAIT)?.map_err(|why| {
            let why = sdo::in_words(&why);
            Failure::Refused(match (address, self.node.entry(address)) {
                ((0x1010, _), _) => format!("it cannot store: {why}"),
                (_, entry) => {
                    let text = entry.map_or_else(String::new, |entry| entry.text(bytes));
                    format!("{} cannot be {text}: {why}", self.node.value_words(address))
                }
            })
        })
    }
}
