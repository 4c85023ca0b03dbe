//! `lss assign`: node-IDs for boards without one, and those of a table.

use std::{collections::BTreeSet, time::Duration};

use canopen_node::{NodeId, lss::Address};

use crate::{
    address,
    arguments::Assign,
    commands::power::{self, HANDS},
    failure::{Failure, Result},
    network::{
        board, nodes,
        rows::{self, Row},
        scan,
    },
    plan::{
        found::{self, Absent, Found, Place},
        new_boards::{Done, Work},
        node_ids::{Fate, NodeIds},
        replacement::replace,
        table::Table,
    },
    session::Session,
};

/// The time between two looks for the next board that somebody plugs in.
const LOOK: Duration = Duration::from_millis(250);

/// Gives node-IDs from `first` on that nobody has. The boards of the table get theirs first, a new one may take over
/// the place of a missing one, and other new ones come into the table.
pub fn assign(session: &mut Session, arguments: &Assign) -> Result {
    let table = arguments.table.as_deref().map(Table::read).transpose()?;
    // The answers come while the nodes are asked.
    board::ask_for_rest(session)?;
    let nodes = nodes::nodes(session)?;
    board::take_back_rest(session)?;
    // Those that are not plugged in yet are not missing.
    let entries =
        table.iter().filter(|_| !arguments.one_at_a_time).flat_map(|table| &table.entries);
    let boards: Vec<_> = entries.map(|(id, address)| (*id, Some(*address))).collect();
    let (found, absent) = match table {
        Some(_) => found::places(session, nodes, &boards)?,
        // Nobody asks which boards they are.
        None => (Found { nodes, ..Found::default() }, Absent::new()),
    };
    let node_ids = NodeIds::new(session, &found, None);
    let mut work = Work { session, first: arguments.first, table, node_ids, done: Done::default() };
    let outcome = carry_out(&mut work, found, absent, arguments);
    let board = |(id, address): &(NodeId, Address)| serde_json::json!({ "node_id": id.get(), "lss_address": address.to_string() });
    let boards: Vec<_> = work.done.new.iter().map(board).collect();
    work.session.found(&serde_json::json!({ "boards": boards, "problems": work.done.problems }))?;
    match outcome {
        Ok(()) => {}
        Err(failure) if work.done.problems.is_empty() => return Err(failure),
        Err(failure) => match failure.of_board() {
            Ok(words) => work.done.problems.push(words),
            Err(stop) => {
                work.done.tell(work.session)?;
                return Err(stop);
            }
        },
    }
    Failure::of(&work.done.problems)
}

fn carry_out(work: &mut Work<'_>, mut found: Found, absent: Absent, arguments: &Assign) -> Result {
    let is_shared = found.nodes.values().any(|numbers| numbers.len() > 1);
    match arguments.one_at_a_time {
        true => one_at_a_time(work)?,
        false => {
            let missing = of_the_table(work, &mut found.places, absent)?;
            if !missing.is_empty() {
                replace(work, &missing, &found.unknown, arguments.yes)?;
            }
            work.give_blank()?;
        }
    }
    if !work.done.new.is_empty() || is_shared {
        work.part()?;
    }
    left_out(work, &found.unknown)?;
    if work.done.new.is_empty() && work.done.problems.is_empty() {
        writeln!(work.session.out, "no board needs a node-ID")?;
    }
    if arguments.power_check
        && let Err(failure) = power::check(work.session)
    {
        work.done.problems.push(failure.of_board()?);
    }
    Ok(())
}

/// Gives the boards of the table their node-IDs; returns the missing ones.
fn of_the_table(
    work: &mut Work<'_>,
    places: &mut [Option<Place>],
    absent: Absent,
) -> Result<Vec<(NodeId, Address)>> {
    let entries = work.entries();
    let mut missing = Vec::new();
    for (number, why) in absent {
        let (id, address) = entries[number];
        match why {
            None => missing.push(entries[number]),
            Some(why) => work.done.note(work.session, id, address, Fate::Failed(why))?,
        }
    }
    let ids: Vec<NodeId> = entries.iter().map(|(id, _)| *id).collect();
    let Work { session, node_ids, done, .. } = work;
    node_ids.give_all(session, &ids, places, false, |session, number, address, fate| {
        done.note(session, ids[number], address, fate)
    })?;
    Ok(missing)
}

/// Names the boards that had a node-ID before, and that the table does not have.
fn left_out(work: &mut Work<'_>, unknown: &[Row]) -> Result {
    let Some(Table { entries, ids, .. }) = &work.table else { return Ok(()) };
    work.session.progress.clear();
    for row in unknown {
        let is_told = |address: &Address| {
            work.done.held.contains(address) || entries.iter().any(|(_, known)| known == address)
        };
        // An entry without an address is for the board that has its node-ID.
        let has_entry =
            |id: &u8| ids.contains(id) && entries.iter().all(|(other, _)| other.get() != *id);
        if row.lss_address.as_ref().is_some_and(is_told)
            || row.node_id.as_ref().is_some_and(has_entry)
        {
            continue;
        }
        let id = row.id_text();
        match row.lss_address {
            Some(address) => writeln!(
                work.session.out,
                "node {id}  {address}  is not in the table: write an entry for it, or take its node-ID away (lss set-id none \
                 --reset --store --address {address}) and assign again"
            )?,
            None => writeln!(
                work.session.out,
                "node {id}  -  is not in the table, and does not say its LSS address"
            )?,
        }
    }
    Ok(())
}

/// Gives node-IDs to boards that a person plugs in one after the other, and says which it is.
fn one_at_a_time(work: &mut Work<'_>) -> Result {
    let mut until = work.session.bus.time();
    let mut told = Vec::new();
    let mut is_any = false;
    let mut is_next = true;
    loop {
        if is_next {
            until = work.session.bus.time() + HANDS;
            work.session.bus.take_unasked();
            work.session.progress.clear();
            let seconds = HANDS.as_secs();
            writeln!(work.session.out, "plug in the next board, within {seconds} s; Enter ends")?;
            work.session.out.flush()?;
        }
        work.session.bus.pass(LOOK)?;
        let is_over = work.session.bus.time() >= until;
        if is_over || work.session.person.answer(|| Ok::<_, Failure>(false))?.is_some() {
            break;
        }
        is_next = named(work)?;
        let mut blank = scan::blank(work.session, &mut work.done.problems)?;
        // One that was pulled out may be tried again.
        work.done.held.retain(|address| blank.contains(address));
        blank.retain(|address| !work.done.held.contains(address));
        match blank[..] {
            [address] => {
                let before = work.done.count();
                work.found(address)?;
                work.done.tell(work.session)?;
                is_next |= work.done.count() != before;
            }
            [_, ..] if blank != told => {
                let boards = address::list(&blank);
                writeln!(
                    work.session.out,
                    "several boards have no node-ID: {boards}. Leave one of them"
                )?;
            }
            _ => {}
        }
        is_any |= is_next;
        told = blank;
    }
    match is_any {
        true => Ok(()),
        false => Err(Failure::NoAnswer("no board was plugged in".into())),
    }
}

/// Names the boards that have come with a node-ID.
fn named(work: &mut Work<'_>) -> Result<bool> {
    let unasked = work.session.bus.take_unasked();
    let ids: BTreeSet<u8> =
        unasked.iter().filter_map(|received| nodes::booted(&received.frame)).collect();
    for id in &ids {
        let numbers = nodes::serial_numbers(work.session, *id)?;
        work.node_ids.note(*id);
        for row in rows::node(work.session, *id, &numbers)? {
            let address = row.address_text();
            writeln!(work.session.out, "node {id}  {address}  has this node-ID already")?;
        }
    }
    Ok(!ids.is_empty())
}
