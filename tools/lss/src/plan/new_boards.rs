//! Node-IDs for boards that no file names: the lowest free ones, which come into the table.

use std::collections::BTreeSet;

use canopen_node::{NodeId, lss::Address};
use lss_master::{Fastscan, Find, Identify, SelectAlone};

use super::{
    node_ids::{Fate, NodeIds},
    table::{Draft, Table},
};
use crate::{
    address::{self, counted},
    failure::{Failure, Result},
    network::{nodes, rows, scan},
    session::Session,
};

/// The giving of node-IDs, as far as it is done.
pub struct Work<'s> {
    pub session: &'s mut Session,
    /// The lowest node-ID to give.
    pub first: NodeId,
    pub table: Option<Table>,
    pub node_ids: NodeIds,
    pub done: Done,
}

/// What became of the boards.
#[derive(Default)]
pub struct Done {
    /// The boards that have got a node-ID.
    pub new: Vec<(NodeId, Address)>,
    /// The boards that stay as they are.
    pub held: Vec<Address>,
    /// What is missing or wrong, in words.
    pub problems: Vec<String>,
    /// How many of them are printed.
    told: usize,
}

impl Done {
    /// The number of boards that have got a node-ID, or that stay as they are.
    pub fn count(&self) -> usize {
        self.new.len() + self.held.len()
    }

    /// Leaves a board as it is, and says why.
    pub fn hold(&mut self, address: Address, why: String) {
        self.held.push(address);
        self.problems.push(why);
    }

    /// Prints the problems before the end of the run.
    pub fn tell(&mut self, session: &mut Session) -> Result {
        session.progress.clear();
        for problem in &self.problems[self.told..] {
            writeln!(session.out, "! {problem}")?;
        }
        self.told = self.problems.len();
        Ok(())
    }

    /// Prints that a board has its node-ID, or names it among the problems.
    pub fn note(
        &mut self,
        session: &mut Session,
        id: NodeId,
        address: Address,
        fate: Fate,
    ) -> Result {
        let how = match fate {
            Fate::Had => "as in the table",
            Fate::Given { boots: true } => "stored, verified by a reset",
            Fate::Given { boots: false } => {
                "stored; it answers after a reset, but sends no boot-up message"
            }
            Fate::Taken => {
                self.hold(address, format!(
                    "another board has node-ID {id}, which the table gives to {address}: give it another one (lss set-id)"
                ));
                return Ok(());
            }
            Fate::Failed(why) => {
                self.hold(address, format!("board {address}: {why}"));
                return Ok(());
            }
        };
        if let Fate::Given { .. } = fate {
            self.new.push((id, address));
        }
        session.progress.clear();
        Ok(writeln!(session.out, "node {id}  {address}  {how}")?)
    }
}

impl Work<'_> {
    pub fn entries(&self) -> Vec<(NodeId, Address)> {
        self.table.iter().flat_map(|table| table.entries.clone()).collect()
    }

    /// The lowest node-ID from the first on that nobody has, and that the table keeps for nobody.
    fn free(&self, first: u8) -> Option<NodeId> {
        let is_kept = |id: &u8| self.table.as_ref().is_some_and(|table| table.ids.contains(id));
        let mut ids = (first..=127).filter(|id| !is_kept(id)).filter_map(NodeId::new);
        ids.find(|id| !self.node_ids.is_taken(*id))
    }

    /// Selects a board, and asks for its node-ID; `None` if it does not tell, and is named among the problems.
    pub fn select(&mut self, address: Address) -> Result<Option<Option<NodeId>>> {
        match self.session.select(address) {
            Ok(id) => Ok(Some(id)),
            Err(failure) => {
                self.done.hold(address, format!("board {address}: {}", failure.of_board()?));
                Ok(None)
            }
        }
    }

    /// Gives the selected board a node-ID; the table becomes the draft. Returns whether it is done: otherwise the board
    /// is named among the problems.
    pub fn give(
        &mut self,
        (id, address): (NodeId, Address),
        before: Option<NodeId>,
        draft: Option<Draft>,
    ) -> Result<bool> {
        let fate = match self.node_ids.give(self.session, address, before, Some(id)) {
            Ok(boots) => Fate::Given { boots },
            Err(failure) => Fate::Failed(failure.of_board()?),
        };
        let is_done = matches!(fate, Fate::Given { .. });
        if let (true, Some(draft), Some(table)) = (is_done, &draft, &mut self.table)
            && let Err(error) = table.take(draft)
        {
            let why = format!("node {id} is not in the table: {address}: {error}");
            self.done.problems.push(why);
        }
        self.done.note(self.session, id, address, fate)?;
        Ok(is_done)
    }

    /// Gives node-IDs to all boards without one.
    pub fn give_blank(&mut self) -> Result {
        self.with_fastscan()?;
        let is_anyone_left =
            self.done.held.is_empty() && scan::is_anyone_without_fastscan(self.session)?;
        if is_anyone_left {
            let given = self.without_fastscan()?;
            if !given || scan::is_anyone_without_fastscan(self.session)? {
                self.done.problems.push(
                    "a board without a node-ID does not answer to Fastscan, nor to identify remote slave with a product \
                     of the table: take all others without one off the bus and use `lss set-id ID --store`"
                        .into(),
                );
            }
        }
        Ok(())
    }

    fn with_fastscan(&mut self) -> Result {
        let mut last: Option<Address> = None;
        // A Fastscan would find a board that stays as it is again and again.
        while self.done.held.is_empty() {
            let count = self.done.new.len();
            self.session
                .progress
                .say(|| format!("{} given; looking for another board", counted(count, "node-ID")));
            let scan = Fastscan::new();
            let scan = last.map_or(scan.clone(), |last| scan.after_slave(last));
            let address = match self.session.carry_out(scan) {
                Ok(Some(address)) => address,
                Ok(None) => return Ok(()),
                Err(stop @ Failure::Stop(_)) => return Err(stop),
                // A bad board spoils it: the other search finds those that it does not.
                Err(_) => break,
            };
            last = Some(address);
            self.selected(address)?;
        }
        loop {
            let mut rest = scan::blank(self.session, &mut self.done.problems)?;
            rest.retain(|address| !self.done.held.contains(address));
            let before = self.done.count();
            for address in rest {
                self.found(address)?;
            }
            if self.done.count() == before {
                return Ok(());
            }
        }
    }

    /// Gives node-IDs to boards that do not support Fastscan, found by identify remote slave: those of the products that
    /// the table or this run knows. Returns whether there were any.
    fn without_fastscan(&mut self) -> Result<bool> {
        let known = self.entries().into_iter().chain(self.done.new.iter().copied());
        let products: BTreeSet<(u32, u32)> =
            known.map(|(_, address)| (address.vendor_id, address.product_code)).collect();
        let before = self.done.new.len();
        for (vendor_id, product_code) in products {
            let mut within = Identify::product(vendor_id, product_code);
            self.session
                .progress
                .say(|| format!("identifying boards of product {product_code:08X}"));
            while let Some(address) = self.session.carry_out(Find::new(within.clone()))? {
                // A device that answers each question has no such address.
                if let Err(failure) = self.session.carry_out(SelectAlone::new(address)) {
                    let why = failure.of_board()?;
                    self.done.problems.push(format!("board {address}: {why}"));
                    break;
                }
                self.found(address)?;
                let Some(next) = address.serial_number.checked_add(1) else { break };
                within.serial_numbers = next..=u32::MAX;
            }
        }
        Ok(self.done.new.len() > before)
    }

    /// Gives a board without a node-ID one.
    pub fn found(&mut self, address: Address) -> Result {
        match self.select(address)? {
            Some(None) => self.selected(address),
            _ => Ok(()),
        }
    }

    /// Gives the selected board without a node-ID one: that of the table, or a free one and an entry there.
    fn selected(&mut self, address: Address) -> Result {
        let is_it = |entry: &&(NodeId, Address)| entry.1 == address;
        if let Some((id, _)) = self.done.new.iter().find(is_it) {
            let why = format!("board {address} has lost node-ID {id} again");
            self.done.hold(address, why);
            return Ok(());
        }
        if let Some(&(id, _)) = self.entries().iter().find(is_it) {
            return match self.node_ids.is_taken(id) {
                true => self.done.note(self.session, id, address, Fate::Taken),
                false => self.give((id, address), None, None).map(drop),
            };
        }
        // A board may have come since.
        self.node_ids.note_heard(self.session);
        let Some(id) = self.free(self.first.get()) else {
            let first = self.first;
            let why = format!("board {address} needs a node-ID, but none from {first} on is free");
            self.done.hold(address, why);
            return Ok(());
        };
        let draft = self.table.as_ref().map(|table| table.with(id, address)).transpose()?;
        self.give((id, address), None, draft).map(drop)
    }

    /// Gives another node-ID to each new board whose node-ID a board has that came later; says who shares one still.
    pub fn part(&mut self) -> Result {
        let nodes = nodes::nodes(self.session)?;
        nodes.keys().for_each(|id| self.node_ids.note(*id));
        self.node_ids.note_heard(self.session);
        let mut is_moved = false;
        for (id, address) in self.done.new.clone() {
            let is_other = |number: &u32| *number != address.serial_number;
            let is_shared =
                nodes.get(&id.get()).is_some_and(|numbers| numbers.iter().any(is_other));
            let (true, Some(other)) = (is_shared, self.free(1)) else { continue };
            if self.select(address)?.is_none() {
                continue;
            }
            writeln!(self.session.out, "another board came with node-ID {id}")?;
            is_moved |= self.give((other, address), Some(id), None)?;
            // The other one has it.
            self.node_ids.note(id.get());
            if self.table.is_some() {
                self.done.note(self.session, id, address, Fate::Taken)?;
            }
        }
        let nodes = if is_moved { nodes::nodes(self.session)? } else { nodes };
        for (id, numbers) in nodes.into_iter().filter(|(_, numbers)| numbers.len() > 1) {
            let rows = rows::node(self.session, id, &numbers)?;
            let addresses = address::list(rows.iter().filter_map(|row| row.lss_address));
            let boards = match addresses.is_empty() {
                true => format!("serial numbers {}", address::parts(&numbers)),
                false => format!("LSS addresses {addresses}"),
            };
            self.done.problems.push(rows::twins(&rows).pop().unwrap_or_else(|| {
                format!(
                    "{} boards have node-ID {id}, with the {boards}: give all but one another (lss set-id --reset)",
                    numbers.len(),
                )
            }));
        }
        Ok(())
    }
}
