//! `lss assign`: node-IDs for boards without one, and those of a table.

use std::collections::BTreeSet;

use canopen_node::{
    NodeId,
    lss::{Address, Request},
};
use lss_master::{Configure, Fastscan, Find, Identify, InquireNodeId, SelectAlone};

use crate::{
    address,
    arguments::Assign,
    commands::{
        power,
        replace::{Replacements, replace},
        set_id::{RESET_COMMUNICATION, reset, take_back, wait_for_boot_up},
    },
    failure::Failure,
    scan,
    session::Session,
    table::Table,
};

/// Gives node-IDs from `first` on that nobody has. The boards of the table get theirs first, a new one may take over
/// the place of a missing one, and other new ones come into the table.
pub fn assign(session: &mut Session<'_>, assign: &Assign) -> Result<(), Failure> {
    let first = assign.first;
    let mut table = assign.table.as_deref().map(Table::read).transpose()?;
    let nodes = scan::nodes(session)?;
    let mut problems = Vec::new();
    let is_shared = nodes.iter().any(|node| shared(node).is_some());
    let entries = table.iter().flat_map(|table| table.entries.clone()).collect::<Vec<_>>();
    let as_known = scan::known(session, &entries, &nodes)?;
    let mut taken: BTreeSet<u8> = nodes.into_keys().collect();
    taken.extend(session.bus.states.keys());
    let mut new = Vec::new();
    let mut missing = Vec::new();
    // They stay as they are.
    let mut held = Vec::new();
    for (id, address) in entries {
        if as_known.contains(&id.get()) {
            let text = address::text(&address);
            writeln!(session.out, "node {}  {text}  as in the table", id.get())?;
            continue;
        }
        session.progress.say(|| format!("looking for node {} of the table", id.get()));
        match session.carry_out(SelectAlone::new(address)) {
            Ok(()) => {
                if let Some(problem) = known(session, id, address, &mut taken, &mut new)? {
                    problems.push(problem);
                    held.push(address);
                }
            }
            Err(Failure::NoAnswer(_)) => missing.push((id, address)),
            Err(failure) => return Err(failure),
        }
    }
    if let Some(table) = &mut table
        && !missing.is_empty()
    {
        let replacements = replace(session, table, &missing, assign.yes, &taken)?;
        let Replacements { done, held: boards, problems: places, .. } = replacements;
        taken.extend(done.iter().map(|(id, _)| id.get()));
        new.extend(done);
        problems.extend(places);
        held.extend(boards);
    }
    // The node-IDs of boards that are missing now stay theirs.
    let reserved = table.iter().flat_map(|table| table.ids.clone());
    taken.extend(reserved);
    let mut last = None;
    while let Some(address) = find_blank(session, new.len(), last, &held)? {
        last = Some(address);
        // A board may have come since.
        taken.extend(session.bus.states.keys());
        let Some(id) = free(first.get(), &taken) else {
            return Err(Failure::Refused(format!(
                "board {} needs a node-ID, but none from {} on is free",
                address::text(&address),
                first.get()
            )));
        };
        give_new(session, (id, address), table.as_mut(), &mut taken, &mut new)?;
    }
    let is_anyone_left = match new.is_empty() {
        _ if !held.is_empty() => false,
        true => scan::is_anyone_without_fastscan(session)?,
        false => scan::is_another_without_fastscan(session)?,
    };
    if is_anyone_left {
        let given = without_fastscan(session, table.as_mut(), first, &mut taken, &mut new)?;
        if !given || scan::is_anyone_without_fastscan(session)? {
            problems.push(
                "a board without a node-ID does not answer to Fastscan, nor to identify remote slave with a product of \
                 the table: take all others without one off the bus and use `lss set-id ID --store`"
                    .into(),
            );
        }
    }
    for (id, address) in &new {
        session.progress.say(|| format!("resetting node {}", id.get()));
        let how = match reset(session, *id, address)? {
            true => "stored, verified by a reset",
            false => "stored; it answers after a reset, but sends no boot-up message",
        };
        session.progress.clear();
        writeln!(session.out, "node {}  {}  {how}", id.get(), address::text(address))?;
    }
    if !new.is_empty() || is_shared {
        problems.extend(part(session, &new, &mut taken)?);
    }
    if new.is_empty() && problems.is_empty() {
        writeln!(session.out, "no board needs a node-ID")?;
    }
    if assign.power_check
        && let Err(failure) = power::check(session)
    {
        match failure {
            Failure::Refused(words) | Failure::NoAnswer(words) => problems.push(words),
            failure => return Err(failure),
        }
    }
    match problems.is_empty() {
        true => Ok(()),
        false => Err(Failure::Refused(problems.join("\n"))),
    }
}

/// The lowest node-ID from `first` on that nobody has.
fn free(first: u8, taken: &BTreeSet<u8>) -> Option<NodeId> {
    (first..=127).find(|id| !taken.contains(id)).and_then(NodeId::new)
}

/// Brings a board without a node-ID to LSS configuration state, but none that is `held`. It looks for one like the last
/// first.
fn find_blank(
    session: &mut Session<'_>,
    count: usize,
    last: Option<Address>,
    held: &[Address],
) -> Result<Option<Address>, Failure> {
    session.progress.say(|| format!("{count} boards have a node-ID now; looking for another"));
    if held.is_empty() {
        let scan = Fastscan::new();
        return session.carry_out(last.map_or(scan.clone(), |last| scan.after_slave(last)));
    }
    // A Fastscan alone would find those that are held again and again.
    let other = scan::blank(session)?.into_iter().find(|address| !held.contains(address));
    if let Some(address) = other {
        session.carry_out(SelectAlone::new(address))?;
    }
    Ok(other)
}

/// Gives the selected board of the table its node-ID; says what is wrong if that cannot be.
fn known(
    session: &mut Session<'_>,
    id: NodeId,
    address: Address,
    taken: &mut BTreeSet<u8>,
    new: &mut Vec<(NodeId, Address)>,
) -> Result<Option<String>, Failure> {
    let text = address::text(&address);
    let before = session.carry_out(InquireNodeId)?;
    if before == Some(id) {
        session.progress.clear();
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

/// Gives a node-ID to the board in LSS configuration state, and stores it. From here on a Ctrl-C waits: a board must
/// not have a node-ID that is not stored.
pub fn give(
    session: &mut Session<'_>,
    id: NodeId,
    address: Address,
    before: Option<NodeId>,
) -> Result<(), Failure> {
    session.bus.check_interrupt()?;
    session.bus.hold_interrupt(true);
    if let Err(failure) = session.carry_out(Configure::node_id(Some(id))) {
        take_back(session, before);
        return Err(match failure {
            Failure::Stop(stop) => stop.into(),
            failure => Failure::Refused(format!("board {}: {failure}", address::text(&address))),
        });
    }
    session.bus.take_unasked();
    session.bus.request(Request::SwitchToWaiting)?;
    if let Some(before) = before {
        session.bus.nmt(RESET_COMMUNICATION, before.get())?;
    }
    wait_for_boot_up(session, id)
}

/// Gives the selected board without a node-ID one, and an entry in the table.
fn give_new(
    session: &mut Session<'_>,
    (id, address): (NodeId, Address),
    table: Option<&mut Table>,
    taken: &mut BTreeSet<u8>,
    new: &mut Vec<(NodeId, Address)>,
) -> Result<(), Failure> {
    let file = table.as_ref().map(|table| table.open_for(id, address)).transpose()?;
    give(session, id, address, None)?;
    taken.insert(id.get());
    new.push((id, address));
    if let (Some(table), Some(file)) = (table, file) {
        table.add(file, id, address)?;
    }
    session.bus.hold_interrupt(false);
    Ok(())
}

/// The words for a node-ID that several nodes have.
fn shared((id, serial_numbers): (&u8, &Vec<u32>)) -> Option<String> {
    let words = || {
        format!(
            "{} boards have node-ID {id}, with the serial numbers {}: give all but one another (lss set-id --reset)",
            serial_numbers.len(),
            address::parts(serial_numbers)
        )
    };
    (serial_numbers.len() > 1).then(words)
}

/// Gives another node-ID to each new board whose node-ID a board has that came later; says who shares one still.
fn part(
    session: &mut Session<'_>,
    new: &[(NodeId, Address)],
    taken: &mut BTreeSet<u8>,
) -> Result<Vec<String>, Failure> {
    let nodes = scan::nodes(session)?;
    taken.extend(nodes.keys().chain(session.bus.states.keys()));
    let mut is_moved = false;
    for (id, address) in new {
        let is_shared = nodes.get(&id.get()).is_some_and(|numbers| numbers.len() > 1);
        let (true, Some(other)) = (is_shared, free(1, taken)) else { continue };
        session.carry_out(SelectAlone::new(*address))?;
        give(session, other, *address, Some(*id))?;
        session.bus.hold_interrupt(false);
        taken.insert(other.get());
        is_moved = true;
        let (text, id, other) = (address::text(address), id.get(), other.get());
        writeln!(
            session.out,
            "node {other}  {text}  stored; another board came with node-ID {id}"
        )?;
    }
    let nodes = if is_moved { scan::nodes(session)? } else { nodes };
    Ok(nodes.iter().filter_map(shared).collect())
}

/// Gives node-IDs to boards that do not support Fastscan, found by identify remote slave: those of the products that
/// the table or this run knows. Returns whether there were any.
fn without_fastscan(
    session: &mut Session<'_>,
    mut table: Option<&mut Table>,
    first: NodeId,
    taken: &mut BTreeSet<u8>,
    new: &mut Vec<(NodeId, Address)>,
) -> Result<bool, Failure> {
    let entries = table.iter().flat_map(|table| table.entries.clone());
    let products: BTreeSet<(u32, u32)> = entries
        .chain(new.iter().copied())
        .map(|(_, address)| (address.vendor_id, address.product_code))
        .collect();
    let mut is_any = false;
    for (vendor_id, product_code) in products {
        let mut within = Identify::product(vendor_id, product_code);
        session.progress.say(|| format!("identifying boards of product {product_code:08X}"));
        while let Some(address) = session.carry_out(Find::new(within.clone()))? {
            session.carry_out(SelectAlone::new(address))?;
            let is_blank = session.carry_out(InquireNodeId)?.is_none();
            if let (true, Some(id)) = (is_blank, free(first.get(), taken)) {
                give_new(session, (id, address), table.as_deref_mut(), taken, new)?;
                is_any = true;
            }
            let Some(next) = address.serial_number.checked_add(1) else { break };
            within.serial_numbers = next..=u32::MAX;
        }
    }
    Ok(is_any)
}
