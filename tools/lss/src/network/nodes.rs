//! The nodes, which have a node-ID, by SDO.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use can_bus::{bus::bits, sdo};
use canopen_node::{Frame, NodeId, lss::Address};

use crate::{
    failure::{Failure, Result},
    session::Session,
};

/// The sub-index of the serial number in object 1018h.
const SERIAL_NUMBER: u8 = 4;
/// More bits than a request and its answer.
const EXCHANGE_BITS: u32 = 320;
/// How often a node that seems to be two is asked again.
const REPEATS: usize = 4;
/// The time between two looks for answers.
const SLICE: Duration = Duration::from_millis(2);
/// How often nodes that do not answer are asked: a frame may be lost.
const ROUNDS: usize = 2;

/// The nodes that answer, by node-ID: the different serial numbers; 0 for a node that refuses to tell its own. If
/// there is only one, and two boards with it answer, it is there twice.
pub type Nodes = BTreeMap<u8, Vec<u32>>;

/// The nodes that answer.
pub fn nodes(session: &mut Session) -> Result<Nodes> {
    session.bus.take_unasked();
    session.bus.has_dropped = false;
    let mut answers = Vec::new();
    let mut asked = Vec::new();
    for round in 0..ROUNDS {
        let is_silent = |id: &u8| answers.iter().all(|(other, _)| other != id);
        let silent: Vec<u8> = (1..=127).filter(is_silent).collect();
        ask_identity(session, &silent, SERIAL_NUMBER)?;
        asked.extend(silent);
        if round + 1 == ROUNDS {
            session.bus.flush()?;
            let wait = session.bus.short();
            session.bus.pass(wait)?;
        }
        answers.extend(identities(session, SERIAL_NUMBER));
    }
    if session.bus.has_dropped {
        return Err(Failure::Refused(
            "more messages of nodes come than can be kept, and answers are among those that were dropped: it is not known \
             who is there. Stop the nodes that send most (lss stop NODE)"
                .into(),
        ));
    }
    let mut nodes = Nodes::new();
    for (id, number) in &answers {
        let numbers = nodes.entry(*id).or_default();
        if !numbers.contains(number) {
            numbers.push(*number);
        }
    }
    for (id, numbers) in &mut nodes {
        let count = answers.iter().filter(|(other, _)| other == id).count();
        let questions = asked.iter().filter(|other| *other == id).count();
        if let ([number], true) = (&numbers[..], count > questions)
            && are_two(session, *id)?
        {
            numbers.push(*number);
        }
    }
    Ok(nodes)
}

/// Whether two boards with one LSS address have this node-ID. Answers at the same moment are one frame, so it is asked
/// several times.
fn are_two(session: &mut Session, id: u8) -> Result<bool> {
    let mut are_two = false;
    for _ in 0..REPEATS {
        are_two |= answers_of(session, id, SERIAL_NUMBER)?.len() > 1;
    }
    Ok(are_two && !session.bus.is_doubled())
}

/// The words for boards that LSS cannot tell apart.
pub fn two(address: Address, id: u8) -> String {
    format!(
        "2 boards have the LSS address {address}, and both are node {id}. LSS cannot tell them apart: take one off the \
         bus, and let its manufacturer give it another serial number. If there is only one, the adapter forwards each frame \
         twice, or the board answers twice"
    )
}

/// Asks these nodes for a part of object 1018h, one after the other without a pause for the answers.
fn ask_identity(session: &mut Session, ids: &[u8], sub_index: u8) -> Result {
    let span = bits(EXCHANGE_BITS, session.bus.rate()) + session.bus.latency() / 2;
    for id in ids {
        session.progress.say(|| format!("asking node {id} of 127"));
        session.bus.send_to(0x600 + u16::from(*id), &sdo::read_request(0x1018, sub_index))?;
        session.bus.pass(span)?;
    }
    Ok(())
}

/// The answers so far with their node-IDs, 0 for a refusal.
fn identities(session: &mut Session, sub_index: u8) -> Vec<(u8, u32)> {
    let answers = session.bus.take_unasked().into_iter().filter_map(|received| {
        let cob_id = received.frame.cob_id();
        let number = sdo_answer(&received.frame, sub_index)?;
        matches!(cob_id, 0x581..=0x5FF).then_some(((cob_id & 0x7F) as u8, number))
    });
    answers.collect()
}

/// Those of the nodes that tell exactly the LSS address that they have here, each with all four parts.
pub fn known(
    session: &mut Session,
    entries: &[(NodeId, Address)],
    nodes: &Nodes,
) -> Result<BTreeSet<u8>> {
    let serial_number = |(id, address): &(NodeId, Address)| {
        // A node that does not tell its serial number is asked by LSS.
        address.serial_number != 0
            && nodes.get(&id.get()).is_some_and(|numbers| **numbers == [address.serial_number])
    };
    let rest: Vec<&(NodeId, Address)> =
        entries.iter().filter(|entry| serial_number(entry)).collect();
    let mut known: BTreeSet<u8> = rest.iter().map(|(id, _)| id.get()).collect();
    for (sub_index, part) in (1..SERIAL_NUMBER).zip(0..3) {
        let ids: Vec<u8> = known.iter().copied().collect();
        ask_identity(session, &ids, sub_index)?;
        let mut answers = identities(session, sub_index);
        let until = session.bus.time() + session.bus.patience();
        while answers.len() < ids.len() && session.bus.time() < until {
            session.bus.pass(SLICE)?;
            answers.extend(identities(session, sub_index));
        }
        let tells = |(id, address): &&&(NodeId, Address)| {
            let parts: [u32; 4] = (*address).into();
            known.contains(&id.get()) && answers.contains(&(id.get(), parts[part]))
        };
        known = rest.iter().filter(tells).map(|(id, _)| id.get()).collect();
    }
    Ok(known)
}

/// The different serial numbers that nodes with this node-ID tell. Other frames stay unasked.
pub fn serial_numbers(session: &mut Session, id: u8) -> Result<Vec<u32>> {
    let mut numbers = answers_of(session, id, SERIAL_NUMBER)?;
    numbers.sort_unstable();
    numbers.dedup();
    Ok(numbers)
}

/// The number in each answer for a part of object 1018h of nodes with this node-ID.
pub fn answers_of(session: &mut Session, id: u8, sub_index: u8) -> Result<Vec<u32>> {
    session.bus.send_to(0x600 + u16::from(id), &sdo::read_request(0x1018, sub_index))?;
    let cob_id = 0x580 + u16::from(id);
    let is_answer =
        |frame: &Frame| frame.cob_id() == cob_id && sdo_answer(frame, sub_index).is_some();
    let mut numbers = Vec::new();
    let wait = session.bus.short();
    while let Some(answer) = session.bus.wait_for(wait, is_answer)? {
        numbers.extend(sdo_answer(&answer.frame, sub_index));
    }
    Ok(numbers)
}

/// The node-ID in a boot-up message.
pub fn booted(frame: &Frame) -> Option<u8> {
    match (frame.cob_id(), frame.data()) {
        (id @ 0x701..=0x77F, [0]) => Some((id & 0x7F) as u8),
        _ => None,
    }
}

/// The number in an answer for a part of object 1018h; 0 for an abort.
fn sdo_answer(frame: &Frame, part: u8) -> Option<u32> {
    match *frame.data() {
        [command, 0x18, 0x10, sub_index, a, b, c, d] if sub_index == part => Some(match command {
            0x80 => 0,
            _ => u32::from_le_bytes([a, b, c, d]),
        }),
        _ => None,
    }
}
