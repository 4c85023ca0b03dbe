//! Who has which node-ID, and how boards get theirs: in an order in which no two boards ever have the same one, also after
//! a power cut in between.

use std::collections::BTreeMap;

use canopen_node::{BitRate, NodeId, lss::Address};
use lss_master::SelectAlone;

use super::found::{Found, Place};
use crate::{
    address::id_text,
    failure::{Failure, Result},
    network::board::{self, Gift},
    session::Session,
};

/// The node-IDs of a network.
pub struct NodeIds {
    /// How many boards have each of them, or may have it.
    taken: BTreeMap<u8, usize>,
    /// The bit rate that boards store with their node-ID, if it is known.
    rate: Option<BitRate>,
}

/// What became of a board that was to get a node-ID.
pub enum Fate {
    /// It has it already, and does not store it again.
    Had,
    /// It has stored it, and sends a boot-up message or does not.
    Given { boots: bool },
    /// Another board has it.
    Taken,
    /// Why it failed with this board alone, in words.
    Failed(String),
}

impl NodeIds {
    /// Those of the boards that were found, and of nodes that were heard.
    pub fn new(session: &Session, found: &Found, rate: Option<BitRate>) -> Self {
        let taken = found.nodes.iter().map(|(id, numbers)| (*id, numbers.len())).collect();
        let mut node_ids = Self { taken, rate };
        for Place { address, id, .. } in found.places.iter().flatten() {
            let Some(id) = id else { continue };
            let is_it = |number: &u32| [0, address.serial_number].contains(number);
            // One that does not answer to SDO is not among the nodes.
            if !found.nodes.get(&id.get()).is_some_and(|numbers| numbers.iter().any(is_it)) {
                *node_ids.taken.entry(id.get()).or_default() += 1;
            }
        }
        found.unknown.iter().filter_map(|row| row.node_id).for_each(|id| node_ids.note(id));
        node_ids.note_heard(session);
        node_ids
    }

    /// Takes note of a node-ID that somebody has.
    pub fn note(&mut self, id: u8) {
        self.taken.entry(id).or_insert(1);
    }

    /// Takes note of the nodes that send of their own accord.
    pub fn note_heard(&mut self, session: &Session) {
        session.bus.heard.keys().for_each(|id| self.note(*id));
    }

    pub fn is_taken(&self, id: NodeId) -> bool {
        self.taken.contains_key(&id.get())
    }

    /// Gives the board in LSS configuration state a node-ID. Returns whether it sends a boot-up message. The node-ID
    /// counts as taken if this fails, too: the board may take it later.
    pub fn give(
        &mut self,
        session: &mut Session,
        address: Address,
        before: Option<NodeId>,
        to: Option<NodeId>,
    ) -> Result<bool> {
        if let Some(to) = to {
            *self.taken.entry(to.get()).or_default() += 1;
        }
        let boots = board::give(session, Gift { address, before, to, rate: self.rate })?;
        if let Some(count) = before.and_then(|before| self.taken.get_mut(&before.get())) {
            *count -= 1;
        }
        self.taken.retain(|_, count| *count > 0);
        Ok(boots)
    }

    /// Gives the boards at these places their node-IDs; with `stores_again`, those that have theirs store them. The places
    /// follow, and `tell` gets the number of each board and what became of it. A board that fails has no place any more.
    pub fn give_all(
        &mut self,
        session: &mut Session,
        ids: &[NodeId],
        places: &mut [Option<Place>],
        stores_again: bool,
        mut tell: impl FnMut(&mut Session, usize, Address, Fate) -> Result,
    ) -> Result {
        let mut waiting = Vec::new();
        for (number, place) in places.iter().enumerate() {
            match place {
                Some(place) if place.id == Some(ids[number]) && !stores_again => {
                    tell(session, number, place.address, Fate::Had)?;
                }
                Some(_) => waiting.push(number),
                None => {}
            }
        }
        loop {
            let has = |number: usize| places[number].and_then(|place| place.id);
            let is_possible =
                |number: &usize| has(*number) == Some(ids[*number]) || !self.is_taken(ids[*number]);
            let is_in_the_way =
                |number: &&usize| waiting.iter().any(|other| has(**number) == Some(ids[*other]));
            let (number, to) = match waiting.iter().position(is_possible) {
                Some(next) => {
                    let number = waiting.remove(next);
                    (number, Some(ids[number]))
                }
                // In a circle one board gives its node-ID up, and is without one for a while.
                None => match waiting.iter().find(is_in_the_way) {
                    Some(number) => (*number, None),
                    None => break,
                },
            };
            let Some(place) = &mut places[number] else { continue };
            let address = place.address;
            session.progress.say(|| format!("node {}: node-ID {}", ids[number], id_text(to)));
            let selected = session.carry_out(SelectAlone::new(address));
            let outcome = selected.and_then(|()| match place.id == to {
                true => {
                    let gift = Gift { address, before: to, to, rate: self.rate };
                    board::store_again(session, gift).map(|()| true)
                }
                false => self.move_to(session, place, to),
            });
            match outcome {
                Ok(boots) if to.is_some() => tell(session, number, address, Fate::Given { boots })?,
                Ok(_) => {}
                Err(failure) => {
                    let why = failure.of_board()?;
                    waiting.retain(|other| *other != number);
                    // Its state is not known, so nothing else is done with it.
                    places[number] = None;
                    tell(session, number, address, Fate::Failed(why))?;
                }
            }
        }
        for number in waiting {
            if let Some(place) = places[number] {
                tell(session, number, place.address, Fate::Taken)?;
            }
        }
        Ok(())
    }

    /// Gives the selected board another node-ID. One that is to have none and refuses that gets one that nobody has.
    fn move_to(
        &mut self,
        session: &mut Session,
        place: &mut Place,
        mut to: Option<NodeId>,
    ) -> Result<bool> {
        let mut outcome = self.give(session, place.address, place.id, to);
        if to.is_none() && matches!(outcome, Err(Failure::Refused(_))) {
            to = (1..=127).rev().filter_map(NodeId::new).find(|id| !self.is_taken(*id));
            session.carry_out(SelectAlone::new(place.address))?;
            outcome = self.give(session, place.address, place.id, to);
        }
        let boots = outcome?;
        place.id = to;
        Ok(boots)
    }
}
