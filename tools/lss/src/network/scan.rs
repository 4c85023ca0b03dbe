//! The boards without a node-ID, by Fastscan. None of them is configured.

use canopen_node::lss::{Address, AddressPart, FastscanStep, Request};
use lss_master::{Outcome, Procedure, Step};

use crate::{
    address::{self, counted},
    failure::{Failure, Result},
    session::Session,
};

/// The bit check that begins a Fastscan.
const BEGIN: u8 = 0x80;
/// How often a Fastscan is repeated that contradicts itself.
const RETRIES: u8 = 3;
/// The most boards that a network has.
const MOST: usize = 127;

/// Whether a board without a node-ID is there that Fastscan has not found. An answer may be lost.
pub fn is_anyone_without_fastscan(session: &mut Session) -> Result<bool> {
    let request = Request::IdentifyNonConfigured;
    for attempt in 0..RETRIES {
        let caution = u8::from(attempt == 0);
        let is_there = match session.bus.slowest_answer() {
            Some(_) => session.carry_out(Probe { request, caution, is_sent: false })?,
            None => session.bus.probe(request)?.is_some(),
        };
        if is_there {
            return Ok(true);
        }
    }
    Ok(false)
}

/// A request to which silence is an answer, and how little it is trusted.
struct Probe {
    request: Request,
    caution: u8,
    is_sent: bool,
}

impl Procedure for Probe {
    type Output = bool;

    fn begin(&mut self) -> Step<bool> {
        if let Some(caution) = self.caution.checked_sub(1) {
            self.caution = caution;
            return Step::SlowDown;
        }
        self.is_sent = true;
        Step::probe(self.request)
    }

    fn next(&mut self, outcome: Outcome) -> Step<bool> {
        match self.is_sent {
            true => Step::Done(outcome.map(|answer| answer.is_some())),
            false => self.begin(),
        }
    }
}

/// The LSS addresses of the boards without a node-ID that support Fastscan. They end in LSS configuration state.
///
/// A Fastscan as a master does it ends with one board in LSS configuration state. This one asks for both values of each
/// bit, and never for the last confirmation: it finds them all. Then all that are found go to LSS configuration state,
/// where they do not answer to Fastscan. Who still answers was missed, since an answer was lost or late. If that does not
/// end, the reason comes to the `problems`, and those are returned that are known.
pub fn blank(session: &mut Session, problems: &mut Vec<String>) -> Result<Vec<Address>> {
    let mut found: Vec<Address> = Vec::new();
    let mut contradictions = 0;
    let mut why = String::new();
    let mut doubtful: Vec<Address> = Vec::new();
    while contradictions < RETRIES {
        let before = found.len();
        let mut more = Vec::new();
        gather(session, &mut found)?;
        // Frames of others may have delayed answers.
        let mut scan = Scan { session, caution: contradictions };
        let outcome = scan.find([0; 4], AddressPart::VendorId, &mut more);
        let is_consistent = match outcome {
            // A device that answers each question would do so again.
            Err(failure @ Failure::Refused(_)) => {
                (why, contradictions) = (failure.to_string(), RETRIES);
                false
            }
            outcome => outcome?,
        };
        more.retain(|address| !found.contains(address));
        if is_consistent && more.is_empty() {
            return Ok(found);
        }
        doubtful.clone_from(&more);
        found.append(&mut more);
        contradictions += u8::from(!is_consistent || found.len() <= before);
    }
    gather(session, &mut found)?;
    doubtful.retain(|address| !found.contains(address));
    if why.is_empty() {
        why = "the answers to Fastscan contradict each other: too many are lost or too late (--latency), or two boards \
               have one LSS address"
            .into();
    }
    for address in doubtful {
        why += &format!("; board {address} does not answer to its selection");
    }
    if !problems.contains(&why) {
        problems.push(why);
    }
    Ok(found)
}

/// Brings all boards that were found to LSS configuration state, and no other; forgets those that are not there.
fn gather(session: &mut Session, found: &mut Vec<Address>) -> Result {
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
fn join(session: &mut Session, address: &Address) -> Result<bool> {
    for request in address::selection(*address) {
        match session.carry_out(request) {
            Err(Failure::NoAnswer(_)) => return Ok(false),
            outcome => outcome?,
        }
    }
    Ok(true)
}

/// More boards than a network has are a contradiction: a search for them would not end.
pub fn check_count(count: usize, service: &str) -> Result {
    match count > MOST {
        true => Err(Failure::Refused(format!(
            "more than {MOST} boards answer to {service}: a device answers each question. Take boards off the bus until \
             the search ends"
        ))),
        false => Ok(()),
    }
}

/// A Fastscan, and how little it trusts silence.
struct Scan<'s> {
    session: &'s mut Session,
    caution: u8,
}

impl Scan<'_> {
    /// Finds the boards whose parts before `part` are the `known` ones; false if the answers contradict each other.
    fn find(
        &mut self,
        mut known: [u32; 4],
        part: AddressPart,
        found: &mut Vec<Address>,
    ) -> Result<bool> {
        // Silence in the beginning ends the search.
        if !self.ask(0, BEGIN, [0, 0], self.caution.max(1))? {
            return Ok(part == AddressPart::VendorId);
        }
        for before in 0..part as u8 {
            let number = known[usize::from(before)];
            if !self.ask(number, 0, [before, before + 1], self.caution)? {
                return Ok(false);
            }
        }
        let mut numbers = Vec::new();
        self.branch(part, 0, 31, found.len(), &mut numbers)?;
        // Each of them leads to a board, or the scan ends.
        for number in &numbers {
            known[part as usize] = *number;
            match AddressPart::new(part as u8 + 1) {
                Some(next) if !self.find(known, next, found)? => return Ok(false),
                Some(_) => {}
                None => found.push(known.into()),
            }
        }
        Ok(!numbers.is_empty())
    }

    /// Finds the numbers of a part whose bits above `bit` are those of `number`.
    fn branch(
        &mut self,
        part: AddressPart,
        number: u32,
        bit: u8,
        known: usize,
        numbers: &mut Vec<u32>,
    ) -> Result {
        let boards = counted(known + numbers.len(), "board");
        self.session.progress.say(|| format!("Fastscan: {boards} so far, {part}"));
        for number in [number, number | 1 << bit] {
            if !self.ask(number, bit, [part as u8; 2], self.caution)? {
                continue;
            }
            match bit.checked_sub(1) {
                Some(bit) => self.branch(part, number, bit, known, numbers)?,
                None => {
                    numbers.push(number);
                    check_count(known + numbers.len(), "Fastscan")?;
                }
            }
        }
        Ok(())
    }

    fn ask(
        &mut self,
        id_number: u32,
        bit_check: u8,
        [sub, next]: [u8; 2],
        caution: u8,
    ) -> Result<bool> {
        let request = Request::Fastscan(FastscanStep { id_number, bit_check, sub, next });
        self.session.carry_out(Probe { request, caution, is_sent: false })
    }
}
