//! The values of a node: compared with the wanted ones, written if they differ, stored, checked after a reset, and then
//! proven by a stamp.

use std::{collections::BTreeSet, time::Duration};

use can_bus::{
    eds,
    sdo::{self, Error},
};
use canopen_node::{NodeId, lss::Address, nmt::State};

use super::{
    node::{Node, STAMP},
    sheet::{LeftOut, pdo},
};
use crate::{
    failure::{Failure, Result},
    network::board::reset,
    session::Session,
};

/// The value that stores all parameters, as it is written to 1010h.
const SAVE: &[u8] = b"save";
/// The wait for the answer to it: a board may erase flash.
const STORE_WAIT: Duration = Duration::from_secs(5);
/// The COB-ID of a PDO, of emergency messages: what it stands for is off.
const OFF: u32 = 1 << 31;
/// The COB-ID of SYNC: the node is its producer.
const PRODUCER: u32 = 1 << 30;

/// The NMT commands start and enter pre-operational.
const START: u8 = 1;
const ENTER_PRE_OPERATIONAL: u8 = 128;
/// The error for a read of a value that can only be written.
const WRITE_ONLY: Error = Error::Abort(0x0601_0001);

/// How the nodes come to their values.
#[derive(Clone, Copy)]
pub struct Manner {
    /// They are stored in any case.
    pub stores_again: bool,
    pub trusts_stamps: bool,
    /// No node goes to pre-operational for its PDOs.
    pub keeps_state: bool,
}

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
    /// The wanted ones that the board cannot get, and why.
    pub left_out: Vec<String>,
    /// The board lacks some of them: no stamp says that it has all.
    pub is_stamp_wrong: bool,
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
    session: &mut Session,
    id: NodeId,
    node: &Node,
    trusts_stamp: bool,
) -> Result<Values> {
    let mut values = Values { are_compared: true, ..Values::default() };
    for left_out in &node.left_out {
        values.left_out.extend(is_left_out(session, id, node, left_out)?);
    }
    if let Some(stamp) = node.stamp {
        for (sub_index, number) in (1..).zip(stamp.numbers) {
            let found = match sdo::read_number(&mut session.bus, id.get(), STAMP, sub_index)? {
                Ok(found) => Some(found),
                Err(why) => {
                    values.leave_out(node, (STAMP, sub_index), &why)?;
                    None
                }
            };
            if found != Some(number) {
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
            true => match sdo::read(&mut session.bus, id.get(), address.0, address.1)? {
                Ok(found) => Some(found),
                Err(why) if why == WRITE_ONLY => None,
                Err(why) => {
                    values.leave_out(node, *address, &why)?;
                    continue;
                }
            },
        };
        if !found.as_ref().is_some_and(|found| node.is_as_wanted(*address, found)) {
            values.changes.push(Change { address: *address, found, wanted: wanted.clone() });
        }
    }
    values.lacks_stamp &= !values.is_stamp_wrong;
    Ok(values)
}

impl Values {
    /// Leaves a value out that the server does not let read; without an answer of it the board is left alone.
    fn leave_out(&mut self, node: &Node, address: eds::Address, why: &Error) -> Result {
        let words = format!("{} cannot be read: {why}", node.value_words(address));
        match why {
            Error::Abort(_) => {
                self.left_out.push(words + ". Is it the data sheet of this board?");
                self.is_stamp_wrong = true;
                Ok(())
            }
            _ => Err(Failure::Refused(words + ". Is the node stopped (NMT)? `lss list` shows it")),
        }
    }
}

/// The words for a value that is left out, unless the board has it.
fn is_left_out(
    session: &mut Session,
    id: NodeId,
    node: &Node,
    LeftOut { words, value }: &LeftOut,
) -> Result<Option<String>> {
    let Some((address, wanted)) = value else { return Ok(Some(words.clone())) };
    let Some(entry) = node.entry(*address).filter(|entry| entry.can_be_read()) else {
        return Ok(Some(words.clone()));
    };
    Ok(match sdo::read(&mut session.bus, id.get(), address.0, address.1)? {
        Ok(found) if node.is_same(*address, &found, wanted) => None,
        // It may follow the node-ID.
        _ if id != node.id => None,
        Ok(found) => {
            Some(format!("{words}, and is {}, not {}", entry.text(&found), entry.text(wanted)))
        }
        Err(why) => Some(format!("{words}: {why}")),
    })
}

/// What was done with a node.
#[derive(Default)]
pub struct Done {
    pub written: usize,
    pub is_stored: bool,
    /// The node was reset, and has its values since then.
    pub is_verified: bool,
    /// The NMT state before was another one, or is not known.
    pub is_pre_operational: bool,
    /// The values that the board has not got, and why.
    pub left_out: Vec<String>,
}

/// Brings the node to the wanted values.
pub fn apply(
    session: &mut Session,
    id: NodeId,
    address: &Address,
    node: &Node,
    manner: Manner,
) -> Result<Done> {
    let mut values = compare(session, id, node, manner.trusts_stamps)?;
    let left_out = std::mem::take(&mut values.left_out);
    let has_none = node.values.is_empty() && node.stamp.is_none();
    let state = session.bus.heard.get(&id.get()).copied().flatten();
    let mut target = Target { session, id, node, manner, state, is_paused: false, left_out };
    let done = match values.are_as_wanted() {
        _ if has_none => Done::default(),
        true if !manner.stores_again || !node.can_store() => Done::default(),
        // Nobody knows whether a run that was cut off has stored them, or their stamp.
        true => {
            target.store()?;
            Done { is_stored: true, ..Done::default() }
        }
        false => target.change(address, &values)?,
    };
    Ok(Done { left_out: target.left_out, ..done })
}

/// A node whose values change.
struct Target<'s> {
    session: &'s mut Session,
    id: NodeId,
    node: &'s Node,
    manner: Manner,
    /// The NMT state before, if it was heard.
    state: Option<u8>,
    /// The node was brought to pre-operational.
    is_paused: bool,
    left_out: Vec<String>,
}

/// A write to a PDO, and the value that was there.
struct Step {
    address: eds::Address,
    wanted: Vec<u8>,
    found: Option<Vec<u8>>,
}

impl Target<'_> {
    fn change(&mut self, address: &Address, values: &Values) -> Result<Done> {
        let refused = self.write_all(&values.changes)?;
        let is_written = |change: &&Change| !refused.contains(&change.address);
        let written: Vec<&Change> = values.changes.iter().filter(is_written).collect();
        let node = self.node;
        let mut done = Done { written: written.len(), ..Done::default() };
        let was_operational = self.state == Some(State::Operational as u8);
        if node.can_store() && (!written.is_empty() || values.lacks_stamp && refused.is_empty()) {
            self.store()?;
            (done.is_stored, done.is_verified) = (true, true);
            done.is_pre_operational = was_operational;
            self.session.progress.say(|| format!("{}: reset", node.words()));
            reset(self.session, self.id, address)?;
        } else if self.is_paused && was_operational {
            self.session.bus.nmt(START, self.id.get())?;
        } else {
            done.is_pre_operational = self.is_paused;
        }
        for Change { address, wanted, .. } in written {
            let Some(entry) = node.entry(*address).filter(|entry| entry.can_be_read()) else {
                continue;
            };
            let words = node.value_words(*address);
            let found = match sdo::read(&mut self.session.bus, self.id.get(), address.0, address.1)?
            {
                Err(why) if why == WRITE_ONLY => continue,
                found => found.map_err(|why| Failure::Refused(format!("{words}: {why}")))?,
            };
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
        if let Some(stamp) = node.stamp.filter(|_| refused.is_empty() && !values.is_stamp_wrong) {
            for (sub_index, number) in (1..).zip(stamp.numbers) {
                self.write((STAMP, sub_index), &number.to_le_bytes())?;
            }
            self.store()?;
        }
        Ok(done)
    }

    /// Writes what differs: a PDO is off meanwhile, and its COB-ID comes last. Returns what the node refuses.
    fn write_all(&mut self, changes: &[Change]) -> Result<BTreeSet<eds::Address>> {
        let pdo = |change: &Change| pdo(change.address);
        let node = self.node;
        let mut refused = BTreeSet::new();
        let others = changes.iter().filter(|change| pdo(change).is_none());
        for (number, change) in (1..).zip(others) {
            let count = changes.len();
            self.session
                .progress
                .say(|| format!("{}: writing value {number} of {count}", node.words()));
            let outcome = self.write_change(change);
            refused.extend(self.is_left_out(outcome)?.then_some(change.address));
        }
        let pdos: BTreeSet<u16> = changes.iter().filter_map(pdo).collect();
        // Many nodes let their PDOs change only there.
        let is_there = self.state == Some(State::PreOperational as u8);
        if !pdos.is_empty() && !is_there && !self.manner.keeps_state {
            self.session.bus.nmt(ENTER_PRE_OPERATIONAL, self.id.get())?;
            self.is_paused = true;
        }
        for index in pdos {
            let of_it = changes.iter().filter(|change| pdo(change) == Some(index));
            let changes: Vec<&Change> = of_it.collect();
            self.session.progress.say(|| format!("{}: PDO {index:04X}", node.words()));
            // Half a PDO would be on the bus otherwise.
            self.session.bus.check_interrupt()?;
            self.session.bus.hold_interrupt(true);
            let outcome = self.write_pdo(index, &changes);
            self.session.bus.hold_interrupt(false);
            if self.is_left_out(outcome)? {
                refused.extend(changes.iter().map(|change| change.address));
            }
        }
        Ok(refused)
    }

    /// Notes what the node refuses; a board that does not answer is a failure.
    fn is_left_out(&mut self, outcome: Result) -> Result<bool> {
        match outcome {
            Err(Failure::Refused(words)) => self.left_out.push(words),
            outcome => return outcome.map(|()| false),
        }
        Ok(true)
    }

    /// Writes a value. A COB-ID that is in use is switched off first (CiA 301, 1005h and 1014h).
    fn write_change(&mut self, change: &Change) -> Result {
        let Change { address, found, wanted } = change;
        let number = found.as_deref().and_then(|found| found.try_into().ok());
        let off = match (address, number.map(u32::from_le_bytes)) {
            ((0x1014, 0), Some(found)) if found & OFF == 0 => Some(found | OFF),
            ((0x1005, 0), Some(found)) if found & PRODUCER != 0 => Some(found & !PRODUCER),
            _ => None,
        };
        let Some(off) = off else { return self.write(*address, wanted) };
        self.write(*address, &off.to_le_bytes())?;
        self.write(*address, wanted).or_else(|failure| {
            let restored = self.write(*address, found.as_deref().unwrap_or_default());
            or_off(failure, restored, &self.node.value_words(*address))
        })
    }

    /// Writes what differs in a PDO with these communication parameters (CiA 301, 7.5.2.36 and 7.5.2.38). If the node
    /// refuses a part, the PDO is as before.
    fn write_pdo(&mut self, index: u16, changes: &[&Change]) -> Result {
        let cob_id = (index, 1);
        let Some(wanted) = self.node.values.get(&cob_id) else {
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
        let steps = self.steps(index, changes);
        for (at, step) in steps.iter().enumerate() {
            let Err(failure) = self.write(step.address, &step.wanted) else { continue };
            let is_undone = |(number, step): &(usize, &Step)| {
                let is_end = step.address == cob_id || step.address == (index + 0x200, 0) && at > 0;
                *number < at || is_end
            };
            let mut undone = steps.iter().enumerate().filter(is_undone);
            let restored = undone.try_for_each(|(_, step)| {
                let unknown = || Failure::Refused(String::new());
                self.write(step.address, step.found.as_ref().ok_or_else(unknown)?)
            });
            return or_off(failure, restored, &format!("PDO {index:04X}"));
        }
        Ok(())
    }

    /// What is written to a PDO that is off, its COB-ID in the end. What does not differ is there as it is wanted.
    fn steps(&self, index: u16, changes: &[&Change]) -> Vec<Step> {
        let wanted = &self.node.values;
        let step = |address: eds::Address| {
            let change = changes.iter().find(|change| change.address == address);
            let wanted = wanted.get(&address).cloned().unwrap_or_default();
            let found = change.map_or(Some(wanted.clone()), |change| change.found.clone());
            Step { address, wanted, found }
        };
        let mut steps = Vec::new();
        let mapping = index + 0x200;
        if changes.iter().any(|change| change.address.0 == mapping) {
            steps.push(Step { address: (mapping, 0), wanted: vec![0], found: Some(vec![0]) });
            let count = step((mapping, 0));
            // Those beyond the number of mapped objects need not exist.
            let last = count.wanted.first().copied().unwrap_or(0);
            let mapped = wanted.range((mapping, 1)..=(mapping, 0xFF)).map(|(address, _)| *address);
            steps.extend(mapped.take_while(|address| address.1 <= last).map(step));
            steps.push(count);
        }
        let others = changes.iter().map(|change| change.address);
        steps.extend(others.filter(|address| address.0 == index && address.1 != 1).map(step));
        steps.push(step((index, 1)));
        steps
    }

    fn store(&mut self) -> Result {
        let node = self.node;
        self.session.progress.say(|| format!("{}: storing", node.words()));
        self.write((0x1010, 1), SAVE)
    }

    fn write(&mut self, address: eds::Address, bytes: &[u8]) -> Result {
        let bus = &mut self.session.bus;
        sdo::download(bus, self.id.get(), address, bytes, STORE_WAIT)?.map_err(|why| {
            let words = match (address, self.node.entry(address)) {
                ((0x1010, _), _) => format!("it cannot store: {why}"),
                (_, entry) => {
                    let text = entry.map_or_else(String::new, |entry| entry.text(bytes));
                    format!("{} cannot be {text}: {why}", self.node.value_words(address))
                }
            };
            match why {
                Error::Abort(_) => Failure::Refused(words),
                _ => Failure::NoAnswer(words),
            }
        })
    }
}

/// Why a part was not written, and whether `all` that was off meanwhile was `restored`.
fn or_off(failure: Failure, restored: Result, all: &str) -> Result {
    let now = match restored {
        Ok(()) => "is as before",
        Err(stop @ Failure::Stop(_)) => return Err(stop),
        Err(_) => "stays off",
    };
    Err(Failure::Refused(format!("{}. {all} {now}", failure.of_board()?)))
}
