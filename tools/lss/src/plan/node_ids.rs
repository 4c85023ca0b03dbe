//! The node-IDs of a plan in an order in which no two boards ever have the same one, also after a power cut in between.

use std::collections::BTreeMap;

use canopen_node::{BitRate, NodeId, lss::Address};
use lss_master::SelectAlone;

use super::{
    files::Network,
    found::{Found, Place},
};
use crate::{
    address::{self, id_text},
    failure::Failure,
    network::board::{self, Gift},
    session::Session,
};

/// How many boards have each node-ID.
type Taken = BTreeMap<NodeId, usize>;

/// Gives each board of the plan its node-ID, and stores it: with `stores_again` also those that have it. They store
/// the bit `rate` of the network, too, if it is known. The places follow; what cannot be done is among the problems of
/// `found`.
pub fn assign(
    session: &mut Session<'_>,
    network: &Network,
    found: &mut Found,
    rate: Option<BitRate>,
    stores_again: bool,
) -> Result<(), Failure> {
    let mut taken = Taken::new();
    let unknown = found.unknown.iter().filter_map(|row| NodeId::new(row.node_id?));
    for id in found.places.iter().flatten().filter_map(|place| place.id).chain(unknown) {
        *taken.entry(id).or_default() += 1;
    }
    let is_waiting = |number: &usize, found: &Found| {
        let place = &found.places[*number];
        place.is_some_and(|place| stores_again || place.id != Some(network.nodes[*number].id))
    };
    let mut waiting: Vec<usize> =
        (0..network.nodes.len()).filter(|number| is_waiting(number, found)).collect();
    let wanted = |number: usize| network.nodes[number].id;
    while !waiting.is_empty() {
        let is_possible = |number: &usize| {
            let has_it =
                found.places[*number].is_some_and(|place| place.id == Some(wanted(*number)));
            has_it || !taken.contains_key(&wanted(*number))
        };
        // In a circle one board gives its node-ID up, and is without one for a while.
        let (number, to) = match waiting.iter().position(is_possible) {
            Some(next) => {
                let number = waiting.remove(next);
                (number, Some(wanted(number)))
            }
            None => {
                let in_the_way = |number: &&usize| {
                    let id = found.places[**number].and_then(|place| place.id);
                    waiting.iter().any(|other| id == Some(wanted(*other)))
                };
                match waiting.iter().find(in_the_way) {
                    Some(number) => (*number, None),
                    None => break,
                }
            }
        };
        let node = &network.nodes[number];
        session.progress.say(|| format!("{}: node-ID {}", node.words(), id_text(to)));
        let Some(place) = &mut found.places[number] else { continue };
        let before = place.id;
        match give(session, place.address, before, to, rate, &taken) {
            Ok(id) => {
                place.id = id;
                place.is_shared = false;
                move_id(&mut taken, before, id);
            }
            Err(failure @ Failure::Stop(_)) => return Err(failure),
            Err(failure) => {
                found.problems.push(format!("{}: {failure}", node.words()));
                // It may have taken it.
                move_id(&mut taken, None, to);
                waiting.retain(|other| *other != number);
                // Its state is not known, so nothing else is done with it.
                found.places[number] = None;
            }
        }
    }
    for number in waiting {
        let id = wanted(number).get();
        found.problems.push(format!(
            "{}: another board has node-ID {id}. Give it another one: lss set-id ID --reset --store --address V:P:R:S",
            network.nodes[number].words()
        ));
    }
    Ok(())
}

fn move_id(taken: &mut Taken, from: Option<NodeId>, to: Option<NodeId>) {
    if let Some(from) = from {
        let count = taken.remove(&from).unwrap_or(0);
        if count > 1 {
            taken.insert(from, count - 1);
        }
    }
    if let Some(to) = to {
        *taken.entry(to).or_default() += 1;
    }
}

/// Gives a node-ID to a board; returns it. A board that is to have none and refuses that gets one that nobody has.
fn give(
    session: &mut Session<'_>,
    address: Address,
    before: Option<NodeId>,
    to: Option<NodeId>,
    rate: Option<BitRate>,
    taken: &Taken,
) -> Result<Option<NodeId>, Failure> {
    let mut gift = Gift { address, before, to, rate };
    let mut outcome = select_and_give(session, gift);
    if to.is_none() && matches!(outcome, Err(Failure::Refused(_))) {
        gift.to = (1..=127).rev().filter_map(NodeId::new).find(|id| !taken.contains_key(id));
        outcome = select_and_give(session, gift);
    }
    outcome.map(|()| gift.to).map_err(|failure| match failure {
        Failure::NoAnswer(why) | Failure::Refused(why) => Failure::Refused(format!(
            "{why}. Board {}: is it still there, and not locked while NMT operational? A further run goes on",
            address::text(&address)
        )),
        failure => failure,
    })
}

fn select_and_give(session: &mut Session<'_>, gift: Gift) -> Result<(), Failure> {
    session.carry_out(SelectAlone::new(gift.address))?;
    match gift.before == gift.to {
        true => board::store_again(session, gift),
        false => board::give(session, gift).map(drop),
    }
}

/// The places of boards that share a node-ID with another are known to be alone after a further look.
pub fn unshare(found: &mut Found) {
    let places: Vec<Place> = found.places.iter().flatten().copied().collect();
    let unknown: Vec<u8> = found.unknown.iter().filter_map(|row| row.node_id).collect();
    for place in found.places.iter_mut().flatten() {
        let Some(id) = place.id else { continue };
        let count = places.iter().filter(|other| other.id == Some(id)).count();
        place.is_shared = count > 1 || unknown.contains(&id.get());
    }
}
