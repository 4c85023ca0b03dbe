//! What is done with one board: it is selected, and it gets a node-ID, which is configured and stored, takes effect, and
//! is read back after a reset. If a step fails, it is taken back.

use std::time::Duration;

use can_bus::{bus::Masters, sdo};
use canopen_node::{
    BitRate, Frame, NodeId,
    lss::{Address, Request},
};
use lss_master::{Configure, SelectAlone};

use super::{nodes, rows};
use crate::{
    address::{id_text, selection},
    failure::{Failure, Result},
    session::Session,
};

/// The NMT command reset communication.
pub const RESET_COMMUNICATION: u8 = 130;
/// The NMT command reset node.
const RESET_NODE: u8 = 129;
/// The time that a board takes to boot up after a reset.
const BOOT: Duration = Duration::from_secs(2);
/// How often a lost frame is made up for.
const ATTEMPTS: usize = 3;
/// The pause between frames for slaves that look for one each 10 ms.
const GAP: Duration = Duration::from_millis(12);
/// The node-ID in LSS messages of a board without one.
const NONE: u8 = NodeId::to_lss(None);

/// A node-ID for a board.
#[derive(Clone, Copy, Debug)]
pub struct Gift {
    pub address: Address,
    /// The one that it has.
    pub before: Option<NodeId>,
    /// The one that it gets.
    pub to: Option<NodeId>,
    /// The bit rate that it stores with it, if that is known.
    pub rate: Option<BitRate>,
}

/// Gives the board in LSS configuration state its node-ID, and lets all boards enter LSS waiting state. Returns whether
/// it sends a boot-up message: some boards send another one. A Ctrl-C waits: no board must have a node-ID that is not
/// stored.
pub fn give(session: &mut Session, gift: Gift) -> Result<bool> {
    session.uninterrupted(|session| {
        configure(session, gift, true)?;
        let boots = prove(session, gift).map_err(|failure| match failure {
            Failure::Stop(_) => failure,
            failure => withdraw(session, gift).unwrap_or_default().unwrap_or(failure),
        })?;
        if let Some(before) = gift.before.filter(|_| gift.before != gift.to) {
            session.bus.heard.remove(&before.get());
        }
        Ok(boots)
    })
}

/// Lets the board in LSS configuration state store the node-ID that it has once more, in case it is not stored.
pub fn store_again(session: &mut Session, gift: Gift) -> Result {
    session.uninterrupted(|session| {
        configure(session, gift, true)?;
        Ok(session.bus.request(Request::SwitchToWaiting)?)
    })
}

/// Makes the node-ID pending in the board in LSS configuration state, and stores it if it `stores`.
pub fn configure(session: &mut Session, gift: Gift, stores: bool) -> Result {
    let Gift { before, to, rate, .. } = gift;
    let mut may_be_stored = false;
    let mut work = || {
        session.carry_out(Request::ConfigureNodeId(NodeId::to_lss(to)))?;
        if let Some(rate) = rate {
            // It runs at this rate. One that cannot be told has it by switches.
            match session.carry_out(Request::ConfigureBitTiming { table: 0, index: rate.index() }) {
                Ok(()) | Err(Failure::Refused(_)) => {}
                Err(failure) => return Err(failure),
            }
        }
        if stores {
            may_be_stored = true;
            session.carry_out(Request::StoreConfiguration)?;
        }
        Ok(())
    };
    let outcome = work();
    if outcome.is_err() {
        // The failure is known, and another one adds nothing.
        let _ = take_back(session, before, may_be_stored);
    }
    outcome
}

/// Makes the node-ID pending again that a board had `before`: it must not take another one at the end of LSS
/// configuration state, nor must others that another master has brought there. It is stored again, too, if the other
/// one may be stored.
fn take_back(session: &mut Session, before: Option<NodeId>, may_be_stored: bool) -> Result {
    session.bus.mind(Masters::None);
    let outcome = match may_be_stored {
        true => session.carry_out(Configure::node_id(before)),
        false => session.carry_out(Request::ConfigureNodeId(NodeId::to_lss(before))),
    };
    session.bus.mind(Masters::Lss);
    outcome
}

/// Takes a stored node-ID back from a board that does not use it, and must not do so later, or that shares it with
/// another board. Returns the words for that, with both addresses.
fn withdraw(session: &mut Session, gift: Gift) -> Result<Option<Failure>> {
    let Gift { address, before, to, .. } = gift;
    let other = match to {
        Some(id) => other(&nodes::serial_numbers(session, id.get())?, &address),
        None => None,
    };
    let has_it = session.select(address)? == to;
    if has_it && other.is_none() {
        return Ok(None);
    }
    let taken_back = take_back(session, before, true);
    let (true, Some(other), Some(id)) = (has_it, other, to.map(NodeId::get)) else {
        return Ok(None);
    };
    // One that has stored what it had is reset: it proves that.
    let command = if taken_back.is_ok() { RESET_NODE } else { RESET_COMMUNICATION };
    let back = take_effect(session, Gift { before: to, to: before, ..gift }, command);
    let fate = match (taken_back, back) {
        (_, Err(stop @ Failure::Stop(_))) => return Err(stop),
        (_, Err(why)) => format!("it cannot be taken back from this one: {why}"),
        (Ok(()), Ok(_)) => "it was taken back from this one, which has stored that".into(),
        (Err(why), Ok(_)) => format!(
            "it was taken back from this one until its next start, since that is not stored: {why}"
        ),
    };
    // Both may still answer.
    let rows = rows::node(session, id, &[address.serial_number, other])?;
    let mut addresses = rows.iter().filter_map(|row| row.lss_address);
    let other = match addresses.find(|address| address.serial_number == other) {
        Some(address) => address.to_string(),
        None => format!("with the serial number {other:08X}"),
    };
    Ok(Some(Failure::Refused(format!("board {other} has node-ID {id}, too: {fate}"))))
}

/// The serial number of another board than that with this LSS address, among those that a node-ID tells. 0 may be a
/// refusal to tell it.
fn other(numbers: &[u32], address: &Address) -> Option<u32> {
    let is_other =
        |number: &&u32| **number != address.serial_number && (**number != 0 || numbers.len() > 1);
    numbers.iter().find(is_other).copied()
}

/// Lets the stored node-ID take effect, and checks that the board has it after a reset.
fn prove(session: &mut Session, gift: Gift) -> Result<bool> {
    let Some(id) = gift.to else { return take_effect(session, gift, RESET_NODE) };
    if gift.before != gift.to {
        take_effect(session, gift, RESET_COMMUNICATION)?;
    }
    reset(session, id, &gift.address)
}

/// Lets a node-ID take effect that is configured: at the end of LSS configuration state if the board has none
/// (CiA 305), or by this NMT command.
pub fn take_effect(session: &mut Session, gift: Gift, command: u8) -> Result<bool> {
    let Gift { address, before, to, .. } = gift;
    boots_up(session, &address, before, to, command, "accepted")
}

/// Resets a node, and checks that the board is there with its node-ID again: it has stored it. Returns whether it sends a
/// boot-up message: some boards send another one.
pub fn reset(session: &mut Session, id: NodeId, address: &Address) -> Result<bool> {
    let boots = boots_up(session, address, Some(id), Some(id), RESET_NODE, "stored")?;
    if !boots {
        return Ok(false);
    }
    let id = id.get();
    // A node need not tell it.
    let number = sdo::read_number(&mut session.bus, id, 0x1018, 4)?.ok();
    let mut unasked = session.bus.take_unasked().into_iter();
    let is_twice = unasked.any(|received| nodes::booted(&received.frame) == Some(id));
    let another = match is_twice {
        true => other(&nodes::serial_numbers(session, id)?, address),
        false => number.filter(|number| *number != address.serial_number),
    };
    match another {
        Some(number) => Err(Failure::Refused(format!(
            "node {id} is another board, with the serial number {number:08X}"
        ))),
        None if is_twice => Err(Failure::Refused(nodes::two(*address, id))),
        None => Ok(true),
    }
}

/// Lets the board `from` boot up as `to`; returns whether it sends a message then. One that is silent is asked by LSS
/// for its node-ID.
fn boots_up(
    session: &mut Session,
    address: &Address,
    from: Option<NodeId>,
    to: Option<NodeId>,
    command: u8,
    verb: &str,
) -> Result<bool> {
    for attempt in 0..ATTEMPTS {
        session.bus.take_unasked();
        // Either the request was lost or the message after it.
        match if attempt % 2 == 0 { from } else { from.and(to).or(from) } {
            Some(id) => session.bus.nmt(command, id.get())?,
            None => session.bus.request(Request::SwitchToWaiting)?,
        }
        let Some(id) = to else {
            if inquired(session, address)?.is_none() {
                return Ok(false);
            }
            continue;
        };
        // Any message is new from a board that had another node-ID.
        let is_sign = |frame: &Frame| {
            let is_of_node = frame.cob_id() == 0x700 + u16::from(id.get());
            is_of_node && (from != to || frame.data() == [0])
        };
        if session.bus.wait_for(BOOT, is_sign)?.is_some() {
            return Ok(true);
        }
    }
    let (id, after) = (id_text(to), if from.is_some() { " after a reset" } else { "" });
    match inquired(session, address) {
        Ok(has) if has == to => Ok(false),
        Ok(has) => {
            let has = id_text(has);
            Err(Failure::Refused(format!("it {verb} node-ID {id}, but has {has}{after}")))
        }
        Err(Failure::NoAnswer(_)) => {
            Err(Failure::Refused(format!("it {verb} node-ID {id}, and is silent{after}")))
        }
        Err(failure) => Err(failure),
    }
}

/// The node-ID that a board has.
fn inquired(session: &mut Session, address: &Address) -> Result<Option<NodeId>> {
    let id = session.select(*address)?;
    session.bus.request(Request::SwitchToWaiting)?;
    Ok(id)
}

/// Asks who is in LSS configuration state, since an earlier run has left it there. [`take_back_rest`] takes the answers.
pub fn ask_for_rest(session: &mut Session) -> Result {
    // Nothing needs to be undone so far.
    session.all_wait = true;
    session.bus.inquired.clear();
    Ok(session.bus.request(Request::InquireNodeId)?)
}

/// Takes back what an earlier run has left: a board that it could not bring to LSS waiting state would take a pending
/// node-ID there, or at a reset of its communication, and nobody has stored it.
pub fn take_back_rest(session: &mut Session) -> Result {
    session.uninterrupted(|session| {
        let ids = std::mem::take(&mut session.bus.inquired);
        // The request for boards without a node-ID is for all, and so is that for the only node.
        let for_all = ids.last().filter(|id| **id == NONE || ids.len() == 1);
        let mut nodes = Vec::new();
        for &id in ids.iter().filter(|id| Some(*id) != for_all) {
            let mut numbers = [0; 4];
            for (number, sub_index) in numbers.iter_mut().zip(1..) {
                *number = sdo::read_number(&mut session.bus, id, 0x1018, sub_index)?
                    .map_err(|why| mixed(id, &why))?;
            }
            nodes.push((id, Address::from(numbers)));
        }
        session.all_wait = false;
        if let Some(id) = for_all {
            match session.carry_out(Request::ConfigureNodeId(*id)) {
                Ok(()) => {}
                // The node had answered twice, and is in LSS waiting state.
                Err(Failure::NoAnswer(_)) if *id != NONE => {}
                Err(Failure::Refused(why) | Failure::NoAnswer(why)) => {
                    return Err(Failure::Refused(format!(
                        "a board may have a node-ID that is not stored: {why}: switch the power of all boards off and on"
                    )));
                }
                Err(failure) => return Err(failure),
            }
        }
        for (id, address) in nodes {
            session.carry_out(SelectAlone::new(address))?;
            session.carry_out(Request::ConfigureNodeId(id))?;
        }
        Ok(())
    })
}

/// The same at once, with a wait for the answers.
pub fn end_earlier_run(session: &mut Session) -> Result {
    ask_for_rest(session)?;
    let wait = session.bus.short();
    session.bus.pass(wait)?;
    take_back_rest(session)
}

/// A node in LSS configuration state beside other boards, and without an LSS address that is known.
fn mixed(id: u8, why: &sdo::Error) -> Failure {
    Failure::Refused(format!(
        "node {id} and other boards are in LSS configuration state together, and it does not tell its LSS address (object \
         1018h: {why}): switch the power of all boards off and on"
    ))
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
    pub fn select(&mut self, session: &mut Session, address: Address) -> Result<bool> {
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
fn is_deserted(session: &mut Session, address: Address) -> Result<bool> {
    if !session.bus.heard.is_empty() || session.bus.slowest_answer().is_some() {
        return Ok(false);
    }
    session.bus.status()?;
    let is_heard = is_heard(session, address)?;
    let status = session.bus.status()?;
    Ok(!is_heard && status.is_some_and(|status| status.has_errors || status.is_error_passive))
}

/// Whether a board answers to its selection soon, at once or after one with pauses, which some slaves need.
fn is_heard(session: &mut Session, address: Address) -> Result<bool> {
    let [first @ .., last] = selection(address);
    for gap in [Duration::ZERO, GAP] {
        for request in [Request::SwitchToWaiting].into_iter().chain(first) {
            session.bus.request(request)?;
            session.bus.pass(gap)?;
        }
        if session.bus.probe(last)?.is_some() {
            return Ok(true);
        }
    }
    Ok(false)
}
