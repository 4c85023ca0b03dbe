//! A new board takes over the place of a missing one in the table.

use std::collections::BTreeSet;

use can_bus::person;
use canopen_node::{NodeId, lss::Address};
use lss_master::{InquireNodeId, SelectAlone};

use crate::{
    address,
    commands::{assign::give, list},
    failure::Failure,
    session::Session,
    table::Table,
};

/// A board of the table, or a new one.
type Board = (NodeId, Address);

/// What the search for a replacement leads to.
#[derive(Default)]
pub struct Replacements {
    /// The boards that have taken over a place.
    pub done: Vec<Board>,
    /// The new boards of which nobody has said what they are: they stay as they are.
    pub held: Vec<Address>,
    /// Why a place is still empty.
    pub problems: Vec<String>,
    /// The node-IDs of the nodes that are there.
    taken: BTreeSet<u8>,
}

/// Finds a new board for each `missing` one. It must be of the same vendor and product. With `is_agreed` it takes over
/// if there is one of each, without a question.
pub fn replace(
    session: &mut Session<'_>,
    table: &mut Table,
    missing: &[Board],
    is_agreed: bool,
    taken: &BTreeSet<u8>,
) -> Result<Replacements, Failure> {
    let mut replacements = Replacements { taken: taken.clone(), ..Replacements::default() };
    let new = new_boards(session, table)?;
    let product = |address: &Address| (address.vendor_id, address.product_code);
    let products: BTreeSet<_> = missing.iter().map(|(_, address)| product(address)).collect();
    for one in products {
        let places = missing.iter().filter(|(_, address)| product(address) == one);
        let places: Vec<Board> = places.copied().collect();
        let boards: Vec<Address> = new.iter().copied().filter(|new| product(new) == one).collect();
        match (&places[..], &boards[..]) {
            (places, []) => replacements.problems.extend(places.iter().map(is_missing)),
            ([place], [board]) if is_agreed => {
                take_over(session, table, *place, *board, &mut replacements)?
            }
            ([place], [board]) if session.person.is_there() => {
                let question = format!(
                    "{}. Board {} is new and of the same product. Does it take over node-ID {}? [y = yes, Enter = no: it \
                     gets one of its own]",
                    is_missing(place),
                    address::text(board),
                    place.0.get()
                );
                let answer = session.ask(&question)?;
                match answer.is_some_and(|answer| person::is_yes(&answer)) {
                    true => take_over(session, table, *place, *board, &mut replacements)?,
                    false => replacements.problems.push(is_missing(place)),
                }
            }
            ([place], [board]) => {
                replacements.problems.push(format!(
                    "{}. Board {} is new and of the same product: with --yes it takes over node-ID {}. Nothing was done \
                     with it",
                    is_missing(place),
                    address::text(board),
                    place.0.get()
                ));
                replacements.held.push(*board);
            }
            (places, boards) if session.person.is_there() => {
                choose(session, table, places, boards.to_vec(), &mut replacements)?;
            }
            (places, boards) => {
                replacements.problems.extend(places.iter().map(is_missing));
                replacements.problems.push(several(places, boards));
                replacements.held.extend(boards);
            }
        }
    }
    Ok(replacements)
}

/// Why nothing was replaced.
fn several(places: &[Board], boards: &[Address]) -> String {
    let boards: Vec<String> = boards.iter().map(address::text).collect();
    let (verb, which) = match (places.len(), boards.len()) {
        (1, _) => ("are", "which one takes over"),
        (_, 1) => ("is", "which place it takes over"),
        _ => ("are", "which one takes over which place"),
    };
    format!(
        "new and of the same product {verb} {}: it is not clear {which}, and nothing was done with them. Run it at a \
         terminal, which asks; or write the new address into the table, or take out what is gone for good",
        boards.join(", ")
    )
}

/// Asks for each place which board takes it over.
fn choose(
    session: &mut Session<'_>,
    table: &mut Table,
    places: &[Board],
    mut boards: Vec<Address>,
    replacements: &mut Replacements,
) -> Result<(), Failure> {
    for place in places {
        let numbered = boards.iter().enumerate();
        let choices: String = numbered
            .map(|(at, board)| format!("\n  {}  {}", at + 1, address::text(board)))
            .collect();
        let question = format!(
            "{}. New and of the same product:{choices}\nWhich one takes over node-ID {}? [its number, Enter = none of them]",
            is_missing(place),
            place.0.get()
        );
        let answer = match boards.is_empty() {
            true => None,
            false => session.ask(&question)?,
        };
        let number: Option<usize> = answer.and_then(|answer| answer.parse().ok());
        match number.and_then(|number| number.checked_sub(1)).filter(|at| *at < boards.len()) {
            Some(at) => take_over(session, table, *place, boards.remove(at), replacements)?,
            None => replacements.problems.push(is_missing(place)),
        }
    }
    Ok(())
}

fn is_missing((id, address): &Board) -> String {
    format!("node {} of the table is missing: {}", id.get(), address::text(address))
}

/// The boards that are not in the table, and that have no node-ID or one that the table gives to another.
fn new_boards(session: &mut Session<'_>, table: &Table) -> Result<Vec<Address>, Failure> {
    let is_known = |address: &Address| table.entries.iter().any(|(_, known)| known == address);
    let is_of_table = |id: u8| table.entries.iter().any(|(known, _)| known.get() == id);
    let rows = list::rows(session)?.into_iter();
    let new = rows.filter(|row| row.node_id.is_none_or(is_of_table));
    Ok(new.filter_map(|row| row.lss_address).filter(|address| !is_known(address)).collect())
}

/// Gives a board the node-ID of a missing one, and writes it into the table.
fn take_over(
    session: &mut Session<'_>,
    table: &mut Table,
    (id, missing): Board,
    board: Address,
    replacements: &mut Replacements,
) -> Result<(), Failure> {
    session.carry_out(SelectAlone::new(board))?;
    let before = session.carry_out(InquireNodeId)?;
    if before != Some(id) && replacements.taken.contains(&id.get()) {
        replacements.problems.push(format!(
            "board {} cannot take over node-ID {}, which another board has: give that another one (lss set-id)",
            address::text(&board),
            id.get()
        ));
        replacements.held.push(board);
        return Ok(());
    }
    give(session, id, board, before)?;
    table.replace(id, board)?;
    session.bus.hold_interrupt(false);
    session.progress.clear();
    let (board_text, missing) = (address::text(&board), address::text(&missing));
    writeln!(session.out, "node {}  {board_text}  takes over the place of {missing}", id.get())?;
    replacements.done.push((id, board));
    Ok(())
}
