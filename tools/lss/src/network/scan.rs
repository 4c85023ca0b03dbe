//! Who is on the bus: the nodes by SDO, and the boards without a node-ID by Fastscan, without a change of state.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use can_bus::{bus::bits, sdo};
use canopen_node::{
    Frame, NodeId,
    lss::{Address, AddressPart, FastscanStep, Request},
};
use lss_master::{Outcome, Procedure, SelectAlone, Step};

use crate::{failure::Failure, session::Session};

/// The sub-index of the serial number in object 1018h.
const SERIAL_NUMBER: u8 = 4;
/// More bits than a request and its answer.
const EXCHANGE_BITS: u32 = 320;
/// The bit check that begins a Fastscan.
const BEGIN: u8 = 0x80;
/// How often a Fastscan is repeated that contradicts itself.
const RETRIES: u8 = 3;
/// The most boards that a network has.
const MOST: usize = 127;
/// How often a node that seems to be two is asked again.
const DOUBTS: usize = 4;

/// The time between two looks for answers.
const SLICE: Duration = Duration::from_millis(2);
/// The pause between frames for slaves that look for one each 10 ms.
const GAP: Duration = Duration::from_millis(12);
/// How often nodes that do not answer are asked: a frame may be lost.
const ROUNDS: usize = 2;

/// The nodes that answer, by node-ID: the different serial numbers; 0 for a node that refuses to tell its own. If
/// there is only one, and two boards with it answer, it is there twice.
pub type Nodes = BTreeMap<u8, Vec<u32>>;

/// The nodes that answer.
pub fn nodes(session: &mut Session<'_>) -> Result<Nodes, Failure> {
    session.bus.take_unasked();
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
fn are_two(session: &mut Session<'_>, id: u8) -> Result<bool, Failure> {
    for _ in 0..DOUBTS {
        if answers_of(session, id, SERIAL_NUMBER)?.len() > 1 {
            return Ok(true);
        }
    }
    Ok(false)
}

/// The words for boards that LSS cannot tell apart.
pub fn two(address: &str, id: u8) -> String {
    format!(
        "2 boards have the LSS address {address}, and both are node {id}. LSS cannot tell them apart: take one off the \
         bus, and let its manufacturer give it another serial number"
    )
}

/// Asks these nodes for a part of object 1018h, one after the other without a pause for the answers.
fn ask_identity(session: &mut Session<'_>, ids: &[u8], sub_index: u8) -> Result<(), Failure> {
    let span = bits(EXCHANGE_BITS, session.bus.rate()) + session.bus.latency() / 2;
    for id in ids {
        session.progress.say(|| format!("asking node {id} of 127"));
        session.bus.send_to(0x600 + u16::from(*id), &sdo::read_request(0x1018, sub_index))?;
        session.bus.pass(span)?;
    }
    Ok(())
}

/// The answers so far with their node-IDs, 0 for a refusal.
fn identities(session: &mut Session<'_>, sub_index: u8) -> Vec<(u8, u32)> {
    let answers = session.bus.take_unasked().into_iter().filter_map(|received| {
        let cob_id = received.frame.cob_id();
        let number = sdo_answer(&received.frame, sub_index)?;
        matches!(cob_id, 0x581..=0x5FF).then_some(((cob_id & 0x7F) as u8, number))
    });
    answers.collect()
}

/// Those of the nodes that tell exactly the LSS address that they have here, each with all four parts.
pub fn known(
    session: &mut Session<'_>,
    entries: &[(NodeId, Address)],
    nodes: &Nodes,
) -> Result<BTreeSet<u8>, Failure> {
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

/// The search for boards by their LSS addresses, of which many may be missing.
#[derive(Default)]
pub struct Search {
    /// A board was asked with patience, and is missing.
    is_anyone_missing: bool,
    /// Nobody takes part in the bus.
    is_deserted: bool,
}

impl Search {
    /// Brings the board with this LSS address to LSS configuration state, and all others to LSS waiting state; false if
    /// it is missing. The first one that is missing costs the patience of the master, and each other one a glance.
    pub fn select(&mut self, session: &mut Session<'_>, address: Address) -> Result<bool, Failure> {
        if self.is_deserted || self.is_anyone_missing && !is_heard(session, address)? {
            return Ok(false);
        }
        match session.carry_out(SelectAlone::new(address)) {
            Ok(()) => Ok(true),
            Err(Failure::NoAnswer(_)) => {
                self.is_anyone_missing = true;
                self.is_deserted = is_deserted(session, address)?;
                Ok(false)
            }
            Err(failure) => Err(failure),
        }
    }
}

/// Whether nobody has sent anything so far, and nobody acknowledges a selection, as the adapter reports.
fn is_deserted(session: &mut Session<'_>, address: Address) -> Result<bool, Failure> {
    if !session.bus.states.is_empty() || session.bus.slowest_answer().is_some() {
        return Ok(false);
    }
    session.bus.status()?;
    let is_heard = is_heard(session, address)?;
    let status = session.bus.status()?;
    Ok(!is_heard && status.is_some_and(|status| status.has_errors || status.is_error_passive))
}

/// Whether a board answers to its selection soon, at once or after one with pauses, which some slaves need.
fn is_heard(session: &mut Session<'_>, address: Address) -> Result<bool, Failure> {
    let Address { vendor_id, product_code, revision_number, serial_number } = address;
    for gap in [Duration::ZERO, GAP] {
        for request in [
            Request::SwitchToWaiting,
            Request::Select(AddressPart::VendorId, vendor_id),
            Request::Select(AddressPart::ProductCode, product_code),
            Request::Select(AddressPart::RevisionNumber, revision_number),
        ] {
            session.bus.request(request)?;
            session.bus.pass(gap)?;
        }
        let last = Request::Select(AddressPart::SerialNumber, serial_number);
        if session.bus.probe(last)?.is_some() {
            return Ok(true);
        }
    }
    Ok(false)
}

/// The different serial numbers that nodes with this node-ID tell. Other frames stay unasked.
pub fn serial_numbers(session: &mut Session<'_>, id: u8) -> Result<Vec<u32>, Failure> {
    let mut numbers = answers_of(session, id, SERIAL_NUMBER)?;
    numbers.sort_unstable();
    numbers.dedup();
    Ok(numbers)
}

/// The number in each answer for a part of object 1018h of nodes with this node-ID.
pub fn answers_of(session: &mut Session<'_>, id: u8, sub_index: u8) -> Result<Vec<u32>, Failure> {
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

/// Whether a board without a node-ID is there, although Fastscan has found none.
pub fn is_anyone_without_fastscan(session: &mut Session<'_>) -> Result<bool, Failure> {
    Ok(session.bus.probe(Request::IdentifyNonConfigured)?.is_some())
}

/// The same after a scan that has found boards, whose answer times are known.
pub fn is_another_without_fastscan(session: &mut Session<'_>) -> Result<bool, Failure> {
    session.carry_out(Probe(Request::IdentifyNonConfigured))
}

/// A request to which silence is an answer.
struct Probe(Request);

impl Procedure for Probe {
    type Output = bool;

    fn begin(&mut self) -> Step<bool> {
        Step::probe(self.0)
    }

    fn next(&mut self, outcome: Outcome) -> Step<bool> {
        Step::Done(outcome.map(|answer| answer.is_some()))
    }
}

/// The LSS addresses of the boards without a node-ID that support Fastscan. They end in LSS configuration state.
///
/// A Fastscan as a master does it ends with one board in LSS configuration state. This one asks for both values of each
/// bit, and never for the last confirmation: it finds them all. Then all that are found go to LSS configuration state,
/// where they do not answer to Fastscan. Who still answers was missed, since an answer was lost or late.
pub fn blank(session: &mut Session<'_>) -> Result<Vec<Address>, Failure> {
    let mut found: Vec<Address> = Vec::new();
    let mut contradictions = 0;
    while contradictions < RETRIES {
        let before = found.len();
        let mut more = Vec::new();
        gather(session, &mut found)?;
        let is_consistent = scan(session, [0; 4], AddressPart::VendorId, &mut more)?;
        more.retain(|address| !found.contains(address));
        if is_consistent && more.is_empty() {
            return Ok(found);
        }
        found.append(&mut more);
        contradictions += u8::from(!is_consistent || found.len() <= before);
    }
    Err(Failure::Refused(
        "the answers to Fastscan contradict each other: too many are lost or too late (--latency), or two boards have \
         one LSS address"
            .into(),
    ))
}

/// Brings all boards that were found to LSS configuration state, and no other; forgets those that are not there.
fn gather(session: &mut Session<'_>, found: &mut Vec<Address>) -> Result<(), Failure> {
    let mut silent = Vec::new();
    'again: loop {
        session.carry_out(Request::SwitchToWaiting)?;
        for (number, address) in found.iter().enumerate() {
            if !join(session, address)? {
                // A board that is there already would not answer again: from the beginning.
                if silent.contains(address) {
                    found.remove(number);
                } else {
                    silent.push(*address);
                }
                continue 'again;
            }
        }
        return Ok(());
    }
}

/// Brings a board to LSS configuration state, and leaves the others where they are.
fn join(session: &mut Session<'_>, address: &Address) -> Result<bool, Failure> {
    session.carry_out(Request::Select(AddressPart::VendorId, address.vendor_id))?;
    session.carry_out(Request::Select(AddressPart::ProductCode, address.product_code))?;
    session.carry_out(Request::Select(AddressPart::RevisionNumber, address.revision_number))?;
    match session.carry_out(Request::Select(AddressPart::SerialNumber, address.serial_number)) {
        Err(Failure::NoAnswer(_)) => Ok(false),
        outcome => outcome.map(|()| true),
    }
}

/// Finds the boards whose parts before `part` are the `known` ones; false if the answers contradict each other.
fn scan(
    session: &mut Session<'_>,
    mut known: [u32; 4],
    part: AddressPart,
    found: &mut Vec<Address>,
) -> Result<bool, Failure> {
    // Silence in the beginning ends the search: it is asked for twice.
    if !begin(session)? && !begin(session)? {
        return Ok(part == AddressPart::VendorId);
    }
    for before in (0..part as u8).filter_map(AddressPart::new) {
        let next = before as u8 + 1;
        if !fastscan(session, known[before as usize], 0, before as u8, next)? {
            return Ok(false);
        }
    }
    let mut numbers = Vec::new();
    branch(session, part, 0, 31, found.len(), &mut numbers)?;
    // Each of them leads to a board, or the scan ends.
    for number in &numbers {
        known[part as usize] = *number;
        match AddressPart::new(part as u8 + 1) {
            Some(next) if !scan(session, known, next, found)? => return Ok(false),
            Some(_) => {}
            None => found.push(known.into()),
        }
    }
    Ok(!numbers.is_empty())
}

/// Finds the numbers of a part whose bits above `bit` are those of `number`.
fn branch(
    session: &mut Session<'_>,
    part: AddressPart,
    number: u32,
    bit: u8,
    known: usize,
    numbers: &mut Vec<u32>,
) -> Result<(), Failure> {
    session.progress.say(|| format!("Fastscan: {} boards so far, {part:?}", known + numbers.len()));
    for number in [number, number | 1 << bit] {
        if !fastscan(session, number, bit, part as u8, part as u8)? {
            continue;
        }
        match bit.checked_sub(1) {
            Some(bit) => branch(session, part, number, bit, known, numbers)?,
            None => {
                numbers.push(number);
                check_count(known + numbers.len(), "Fastscan")?;
            }
        }
    }
    Ok(())
}

/// More boards than a network has are a contradiction: a search for them would not end.
pub fn check_count(count: usize, service: &str) -> Result<(), Failure> {
    match count > MOST {
        true => Err(Failure::Refused(format!(
            "more than {MOST} boards answer to {service}: a device answers each question. Take boards off the bus until \
             the search ends"
        ))),
        false => Ok(()),
    }
}

fn begin(session: &mut Session<'_>) -> Result<bool, Failure> {
    fastscan(session, 0, BEGIN, 0, 0)
}

fn fastscan(
    session: &mut Session<'_>,
    id_number: u32,
    bit_check: u8,
    sub: u8,
    next: u8,
) -> Result<bool, Failure> {
    let step = FastscanStep { id_number, bit_check, sub, next };
    session.carry_out(Probe(Request::Fastscan(step)))
}
