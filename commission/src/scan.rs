//! Who is on the bus: the nodes by SDO, and the boards without a node-ID by Fastscan, without a change of state.

use std::collections::BTreeMap;

use can_bus::bus::bits;
use canopen_node::{
    Frame,
    lss::{Address, AddressPart, FastscanStep, Request},
};
use lss_master::{Outcome, Procedure, Step};

use crate::{failure::Failure, session::Session};

/// The sub-index of the serial number in object 1018h.
const SERIAL_NUMBER: u8 = 4;
/// More bits than a request and its answer.
const EXCHANGE_BITS: u32 = 320;
/// The bit check that begins a Fastscan.
const BEGIN: u8 = 0x80;
/// How often a Fastscan is repeated that contradicts itself.
const RETRIES: u8 = 3;

/// The nodes that answer, by node-ID: the different serial numbers; 0 for a node that refuses to tell its own.
pub fn nodes(session: &mut Session<'_>) -> Result<BTreeMap<u8, Vec<u32>>, Failure> {
    session.bus.take_unasked();
    let span = bits(EXCHANGE_BITS, session.bus.rate()) + session.bus.latency() / 2;
    for id in 1..=127_u8 {
        session.progress.say(|| format!("asking node {id} of 127"));
        let request = [0x40, 0x18, 0x10, SERIAL_NUMBER, 0, 0, 0, 0];
        session.bus.send_to(0x600 + u16::from(id), &request)?;
        session.bus.pass(span)?;
    }
    session.bus.flush()?;
    let wait = session.bus.short();
    session.bus.pass(wait)?;
    let mut nodes: BTreeMap<u8, Vec<u32>> = BTreeMap::new();
    for received in session.bus.take_unasked() {
        let cob_id = received.frame.cob_id();
        if let (0x581..=0x5FF, Some(number)) = (cob_id, sdo_answer(&received.frame)) {
            let numbers = nodes.entry((cob_id & 0x7F) as u8).or_default();
            if !numbers.contains(&number) {
                numbers.push(number);
            }
        }
    }
    Ok(nodes)
}

/// The different serial numbers that nodes with this node-ID tell, as in [`nodes`]. Other frames stay unasked.
pub fn serial_numbers(session: &mut Session<'_>, id: u8) -> Result<Vec<u32>, Failure> {
    let request = [0x40, 0x18, 0x10, SERIAL_NUMBER, 0, 0, 0, 0];
    session.bus.send_to(0x600 + u16::from(id), &request)?;
    let cob_id = 0x580 + u16::from(id);
    let is_answer = |frame: &Frame| frame.cob_id() == cob_id && sdo_answer(frame).is_some();
    let mut numbers = Vec::new();
    let wait = session.bus.short();
    while let Some(answer) = session.bus.wait_for(wait, is_answer)? {
        numbers.extend(sdo_answer(&answer.frame).filter(|number| !numbers.contains(number)));
    }
    Ok(numbers)
}

/// The number in an answer for the serial number; 0 for an abort.
fn sdo_answer(frame: &Frame) -> Option<u32> {
    match *frame.data() {
        [command, 0x18, 0x10, SERIAL_NUMBER, a, b, c, d] => Some(match command {
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
        "the answers to Fastscan contradict each other: too many are lost or too late (--latency)"
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
            None => numbers.push(number),
        }
    }
    Ok(())
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
