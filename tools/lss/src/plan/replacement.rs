//! A new board takes over the place of a missing one in the table.

use std::collections::BTreeSet;

use can_bus::person;
use canopen_node::{NodeId, lss::Address};

use super::new_boards::Work;
use crate::{
    address,
    failure::Result,
    network::rows::{self, Row},
};

/// A board of the table, or a new one.
type Board = (NodeId, Address);

/// Finds a new board for each `missing` one. It must be of the same vendor and product. With `is_agreed` it takes over
/// if there is one of each, without a question.
pub fn replace(work: &mut Work<'_>, missing: &[Board], unknown: &[Row], is_agreed: bool) -> Result {
    let table = work.entries();
    let is_of_table = |id: u8| table.iter().any(|(known, _)| known.get() == id);
    let mut new: Vec<Address> = Vec::new();
    for row in unknown.iter().chain(&rows::blank(work.session, &mut work.done.problems)?) {
        new.extend(row.lss_address.filter(|_| row.node_id.is_none_or(is_of_table)));
    }
    new.retain(|address| table.iter().all(|(_, known)| known != address));
    let product = |address: &Address| (address.vendor_id, address.product_code);
    let products: BTreeSet<_> = missing.iter().map(|(_, address)| product(address)).collect();
    for one in products {
        let places = missing.iter().filter(|(_, address)| product(address) == one);
        let places: Vec<Board> = places.copied().collect();
        let boards: Vec<Address> = new.iter().copied().filter(|new| product(new) == one).collect();
        match (&places[..], &boards[..]) {
            (places, []) => work.done.problems.extend(places.iter().map(is_missing)),
            ([place], [board]) if is_agreed => take_over(work, *place, *board)?,
            (places, _) if work.session.person.is_present() => choose(work, places, boards)?,
            ([place], [board]) => {
                let (new, id) = (is_new(place, board), place.0);
                let why = format!(
                    "{new}: with --yes it takes over node-ID {id}. Nothing was done with it"
                );
                work.done.hold(*board, why);
            }
            (places, boards) => {
                work.done.problems.extend(places.iter().map(is_missing));
                work.done.problems.push(several(places, boards));
                work.done.held.extend(boards);
            }
        }
    }
    Ok(())
}

/// Why nothing was replaced.
fn several(places: &[Board], boards: &[Address]) -> String {
    let (verb, which) = match (places.len(), boards.len()) {
        (1, _) => ("are", "which one takes over"),
        (_, 1) => ("is", "which place it takes over"),
        _ => ("are", "which one takes over which place"),
    };
    format!(
        "new and of the same product {verb} {}: it is not clear {which}, and nothing was done with them. Run it at a \
         terminal, which asks; or write the new address into the table, or take out what is gone for good",
        address::list(boards)
    )
}

/// Asks for each place which board takes it over.
fn choose(work: &mut Work<'_>, places: &[Board], mut boards: Vec<Address>) -> Result {
    let is_one = places.len() == 1 && boards.len() == 1;
    for place in places {
        let id = place.0;
        let at = match &boards[..] {
            [] => None,
            [board] if is_one => {
                let question = format!(
                    "{}. Does it take over node-ID {id}? [y = yes, Enter = no: it gets one of its own]",
                    is_new(place, board)
                );
                work.session.ask(&question)?.filter(|answer| person::is_yes(answer)).map(|_| 0)
            }
            boards => {
                let numbered = (1..).zip(boards);
                let choices: String =
                    numbered.map(|(number, board)| format!("\n  {number}  {board}")).collect();
                let question = format!(
                    "{}. New and of the same product:{choices}\nWhich one takes over node-ID {id}? [its number, Enter = none \
                     of them]",
                    is_missing(place)
                );
                let answer = work.session.ask(&question)?;
                answer.and_then(|answer| answer.parse::<usize>().ok()?.checked_sub(1))
            }
        };
        match at.filter(|at| *at < boards.len()) {
            Some(at) => take_over(work, *place, boards.remove(at))?,
            None => work.done.problems.push(is_missing(place)),
        }
    }
    Ok(())
}

/// The words for a place, and the only board that may take it over.
fn is_new(place: &Board, board: &Address) -> String {
    format!("{}. Board {board} is new and of the same product", is_missing(place))
}

fn is_missing((id, address): &Board) -> String {
    format!("node {id} of the table is missing: {address}")
}

/// Gives a board the node-ID of a missing one, and writes it into the table.
fn take_over(work: &mut Work<'_>, (id, missing): Board, board: Address) -> Result {
    let Some(before) = work.select(board)? else { return Ok(()) };
    if before != Some(id) && work.node_ids.is_taken(id) {
        let why = format!(
            "board {board} cannot take over node-ID {id}, which another board has: give that another one (lss set-id)"
        );
        work.done.hold(board, why);
        return Ok(());
    }
    let table = work.table.as_ref();
    let draft = table.map(|table| table.with_another(id, board)).transpose()?;
    if work.give((id, board), before, draft)? {
        writeln!(work.session.out, "node {id}  {board}  takes over the place of {missing}")?;
    }
    Ok(())
}
