//! `lss assign`: node-IDs for boards without one, and those of a table.

use std::{collections::BTreeSet, path::Path};

use can_bus::sdo;
use canopen_node::{
    NodeId,
    lss::{Address, Request},
};
use lss_master::{Configure, Fastscan, InquireNodeId, Select};

use crate::{
    address,
    commands::set_id::{RESET_COMMUNICATION, wait_for_boot_up},
    failure::Failure,
    scan,
    session::Session,
    table::Table,
};

/// The NMT command reset node.
const RESET_NODE: u8 = 129;

/// Gives node-IDs from `first` on that nobody has. The boards of the table get theirs first, and new ones come into it.
pub fn assign(
    session: &mut Session<'_>,
    first: NodeId,
    table: Option<&Path>,
) -> Result<(), Failure> {
    let mut table = table.map(Table::read).transpose()?;
    let mut taken: BTreeSet<u8> = scan::nodes(session)?.into_keys().collect();
    taken.extend(session.bus.states.keys());
    let mut new = Vec::new();
    let mut problems = Vec::new();
    for (id, address) in table.iter().flat_map(|table| table.entries.clone()) {
        session.progress.say(|| format!("looking for node {} of the table", id.get()));
        if let Some(problem) = known(session, id, address, &mut taken, &mut new)? {
            problems.push(problem);
        }
    }
    // The node-IDs of boards that are missing now stay theirs.
    let reserved = table.iter().flat_map(|table| table.entries.iter().map(|(id, _)| id.get()));
    taken.extend(reserved);
    while let Some(address) = find_blank(session, new.len())? {
        let Some(id) = (first.get()..=127).find(|id| !taken.contains(id)).and_then(NodeId::new)
        else {
            return Err(Failure::Refused(format!(
                "board {} needs a node-ID, but none from {} on is free",
                address::text(&address),
                first.get()
            )));
        };
        give(session, id, address, None)?;
        taken.insert(id.get());
        new.push((id, address));
        if let Some(table) = &mut table {
            table.add(id, address)?;
        }
        session.bus.hold_interrupt(false);
    }
    if new.is_empty() && scan::is_anyone_without_fastscan(session)? {
        problems.push(
            "a board without a node-ID does not answer to Fastscan: take all others without one off the bus and use \
             `lss set-id ID --store`"
                .into(),
        );
    }
    for (id, address) in &new {
        session.progress.say(|| format!("resetting node {}", id.get()));
        verify(session, *id, address)?;
    }
    if new.is_empty() && problems.is_empty() {
        writeln!(session.out, "no board needs a node-ID")?;
    }
    match problems.is_empty() {
        true => Ok(()),
        false => Err(Failure::Refused(problems.join("\n"))),
    }
}

/// Brings a board without a node-ID to LSS configuration state.
fn find_blank(session: &mut Session<'_>, count: usize) -> Result<Option<Address>, Failure> {
    session.progress.say(|| format!("{count} boards have a node-ID now; looking for another"));
    session.carry_out(Fastscan::new())
}

/// Gives a board of the table its node-ID; says what is wrong if that cannot be.
fn known(
    session: &mut Session<'_>,
    id: NodeId,
    address: Address,
    taken: &mut BTreeSet<u8>,
    new: &mut Vec<(NodeId, Address)>,
) -> Result<Option<String>, Failure> {
    let text = address::text(&address);
    match session.carry_out(Select(address)) {
        Ok(()) => {}
        Err(Failure::NoAnswer(_)) => {
            return Ok(Some(format!("node {} of the table is missing: {text}", id.get())));
        }
        Err(failure) => return Err(failure),
    }
    let before = session.carry_out(InquireNodeId)?;
    if before == Some(id) {
        writeln!(session.out, "node {}  {text}  as in the table", id.get())?;
        return Ok(None);
    }
    if taken.contains(&id.get()) {
        return Ok(Some(format!(
            "another board has node-ID {}, which the table gives to {text}: give it another one (lss set-id)",
            id.get()
        )));
    }
    give(session, id, address, before)?;
    session.bus.hold_interrupt(false);
    if let Some(before) = before {
        taken.remove(&before.get());
    }
    taken.insert(id.get());
    new.push((id, address));
    Ok(None)
}

/// Gives a node-ID to the board in LSS configuration state, and stores it. From here on a Ctrl-C waits: a board must not
/// have a node-ID that is not stored.
fn give(
    session: &mut Session<'_>,
    id: NodeId,
    address: Address,
    before: Option<NodeId>,
) -> Result<(), Failure> {
    session.bus.check_interrupt()?;
    session.bus.hold_interrupt(true);
    if let Err(failure) = session.carry_out(Configure::node_id(Some(id))) {
        // It must not take the node-ID at the end of LSS configuration state.
        let _ = session.carry_out(Request::ConfigureNodeId(NodeId::to_lss(before)));
        return Err(Failure::Refused(format!("board {}: {failure}", address::text(&address))));
    }
    session.bus.take_unasked();
    session.bus.request(Request::SwitchToWaiting)?;
    if let Some(before) = before {
        session.bus.nmt(RESET_COMMUNICATION, before.get())?;
    }
    wait_for_boot_up(session, id)
}

/// Resets a node, and checks that the board is there with its node-ID again.
fn verify(session: &mut Session<'_>, id: NodeId, address: &Address) -> Result<(), Failure> {
    session.bus.take_unasked();
    session.bus.nmt(RESET_NODE, id.get())?;
    wait_for_boot_up(session, id)?;
    let text = address::text(address);
    match sdo::read_number(&mut session.bus, id.get(), 0x1018, 4)? {
        Ok(number) if number != address.serial_number => Err(Failure::Refused(format!(
            "node {} is not board {text}: its serial number is {number:08X}",
            id.get()
        ))),
        // A node need not tell its serial number.
        _ => Ok(writeln!(session.out, "node {}  {text}  stored, verified by a reset", id.get())?),
    }
}
