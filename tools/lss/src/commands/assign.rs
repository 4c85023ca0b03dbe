//! `lss assign`: node-IDs for boards without one, and those of a table.

use std::{collections::BTreeSet, time::Duration};

use canopen_node::{Frame, NodeId, lss::Address};
use lss_master::{Fastscan, Find, Identify, InquireNodeId, SelectAlone};

use crate::{
    address,
    arguments::Assign,
    commands::power,
    failure::Failure,
    network::{
        board::{Gift, Search, ask_for_rest, give, take_back_rest},
        nodes, rows, scan,
    },
    plan::{
        replacement::replace,
        table::{Draft, Table},
    },
    session::Session,
};

/// The wait for the next board that somebody plugs in.
const HANDS: Duration = Duration::from_secs(120);
/// The time between two looks for it.
const LOOK: Duration = Duration::from_millis(250);

/// Gives node-IDs from `first` on that nobody has. The boards of the table get theirs first, a new one may take over
/// the place of a missing one, and other new ones come into the table.
pub fn assign(session: &mut Session<'_>, arguments: &Assign) -> Result<(), Failure> {
    let mut work = Work {
        first: arguments.first,
        table: arguments.table.as_deref().map(Table::read).transpose()?,
        taken: BTreeSet::new(),
        new: Vec::new(),
        held: Vec::new(),
        problems: Vec::new(),
        told: 0,
    };
    match work.carry_out(session, arguments) {
        Ok(()) => {}
        Err(failure) if work.problems.is_empty() => return Err(failure),
        Err(failure) => match failure.of_board() {
            Ok(words) => work.problems.push(words),
            Err(stop) => {
                work.tell(session)?;
                return Err(stop);
            }
        },
    }
    match work.problems.is_empty() {
        true => Ok(()),
        false => Err(Failure::Refused(work.problems.join("\n"))),
    }
}

/// The assignment, as far as it is done.
pub struct Work {
    first: NodeId,
    pub table: Option<Table>,
    /// The node-IDs that boards have, or may have.
    pub taken: BTreeSet<u8>,
    /// The boards that have got a node-ID.
    new: Vec<(NodeId, Address)>,
    /// The boards that stay as they are.
    pub held: Vec<Address>,
    /// What is missing or wrong, in words.
    pub problems: Vec<String>,
    /// How many of them are printed.
    told: usize,
}

impl Work {
    fn carry_out(&mut self, session: &mut Session<'_>, arguments: &Assign) -> Result<(), Failure> {
        // The answers come while the nodes are asked.
        ask_for_rest(session)?;
        let nodes = nodes::nodes(session)?;
        take_back_rest(session)?;
        let is_shared = nodes.values().any(|numbers| numbers.len() > 1);
        match arguments.one_at_a_time {
            true => {
                self.taken.extend(nodes.keys());
                self.one_at_a_time(session)?;
            }
            false => self.all(session, nodes, arguments.yes)?,
        }
        if !self.new.is_empty() || is_shared {
            self.part(session)?;
        }
        if self.new.is_empty() && self.problems.is_empty() {
            writeln!(session.out, "no board needs a node-ID")?;
        }
        if arguments.power_check
            && let Err(failure) = power::check(session)
        {
            self.problems.push(failure.of_board()?);
        }
        Ok(())
    }

    /// Gives node-IDs to all boards that are there.
    fn all(
        &mut self,
        session: &mut Session<'_>,
        nodes: nodes::Nodes,
        is_agreed: bool,
    ) -> Result<(), Failure> {
        let entries = self.entries();
        let as_known = nodes::known(session, &entries, &nodes)?;
        self.taken.extend(nodes.into_keys());
        self.taken.extend(session.bus.states.keys());
        let mut missing = Vec::new();
        let mut search = Search::default();
        for (id, address) in entries {
            if as_known.contains(&id.get()) {
                as_in_the_table(session, id, address)?;
                continue;
            }
            session.progress.say(|| format!("looking for node {} of the table", id.get()));
            let outcome = match search.select(session, address) {
                Ok(true) => session
                    .carry_out(InquireNodeId)
                    .and_then(|before| self.known(session, id, address, before)),
                Ok(false) => {
                    missing.push((id, address));
                    Ok(())
                }
                Err(failure) => Err(failure),
            };
            self.hold_after(address, outcome)?;
        }
        if !missing.is_empty() {
            replace(session, self, &missing, is_agreed)?;
        }
        self.blank(session)?;
        let is_anyone_left = match self.new.is_empty() {
            _ if !self.held.is_empty() => false,
            true => scan::is_anyone_without_fastscan(session)?,
            false => scan::is_another_without_fastscan(session)?,
        };
        if is_anyone_left {
            let given = self.without_fastscan(session)?;
            if !given || scan::is_anyone_without_fastscan(session)? {
                self.problems.push(
                    "a board without a node-ID does not answer to Fastscan, nor to identify remote slave with a product \
                     of the table: take all others without one off the bus and use `lss set-id ID --store`"
                        .into(),
                );
            }
        }
        Ok(())
    }

    pub fn entries(&self) -> Vec<(NodeId, Address)> {
        self.table.iter().flat_map(|table| table.entries.clone()).collect()
    }

    /// The lowest node-ID from the first on that nobody has, and that the table keeps for nobody.
    fn free(&self, first: u8) -> Option<NodeId> {
        let is_kept = |id: &u8| self.table.as_ref().is_some_and(|table| table.ids.contains(id));
        (first..=127).find(|id| !self.taken.contains(id) && !is_kept(id)).and_then(NodeId::new)
    }

    /// The number of boards that have got a node-ID, or that stay as they are.
    fn decided(&self) -> usize {
        self.new.len() + self.held.len()
    }

    /// Leaves a board as it is, and says why.
    pub fn hold(&mut self, address: Address, why: String) {
        self.held.push(address);
        self.problems.push(why);
    }

    /// Leaves a board as it is if something has failed with it alone; returns what has not.
    fn hold_after<T>(
        &mut self,
        address: Address,
        outcome: Result<T, Failure>,
    ) -> Result<Option<T>, Failure> {
        match outcome {
            Ok(done) => Ok(Some(done)),
            Err(failure) => {
                let text = address::text(&address);
                self.hold(address, format!("board {text}: {}", failure.of_board()?));
                Ok(None)
            }
        }
    }

    /// Selects a board, and asks for its node-ID; `None` if it does not tell, and is named among the problems.
    pub fn select(
        &mut self,
        session: &mut Session<'_>,
        address: Address,
    ) -> Result<Option<Option<NodeId>>, Failure> {
        let selected = session.carry_out(SelectAlone::new(address));
        let id = selected.and_then(|()| session.carry_out(InquireNodeId));
        self.hold_after(address, id)
    }

    /// Prints the problems before the end of the run.
    fn tell(&mut self, session: &mut Session<'_>) -> Result<(), Failure> {
        session.progress.clear();
        for problem in &self.problems[self.told..] {
            writeln!(session.out, "! {problem}")?;
        }
        self.told = self.problems.len();
        Ok(())
    }

    /// Gives the selected board a node-ID; the table becomes the draft. Returns whether it is done: otherwise the board
    /// is named among the problems.
    pub fn give(
        &mut self,
        session: &mut Session<'_>,
        (id, address): (NodeId, Address),
        before: Option<NodeId>,
        draft: Option<Draft>,
    ) -> Result<bool, Failure> {
        let text = address::text(&address);
        // Also if it does not take it: it may do so later.
        self.taken.insert(id.get());
        let outcome = give(session, Gift { address, before, to: Some(id), rate: None });
        let how = match self.hold_after(address, outcome)? {
            Some(true) => "stored, verified by a reset",
            Some(false) => "stored; it answers after a reset, but sends no boot-up message",
            None => return Ok(false),
        };
        if let (Some(draft), Some(table)) = (&draft, &mut self.table)
            && let Err(error) = table.take(draft)
        {
            self.problems.push(format!("node {} is not in the table: {text}: {error}", id.get()));
        }
        if let Some(before) = before {
            self.taken.remove(&before.get());
        }
        self.new.push((id, address));
        session.progress.clear();
        writeln!(session.out, "node {}  {text}  {how}", id.get())?;
        Ok(true)
    }

    /// Gives the selected board of the table its node-ID, unless another one has it.
    fn known(
        &mut self,
        session: &mut Session<'_>,
        id: NodeId,
        address: Address,
        before: Option<NodeId>,
    ) -> Result<(), Failure> {
        if before == Some(id) {
            return as_in_the_table(session, id, address);
        }
        if self.taken.contains(&id.get()) {
            let why = format!(
                "another board has node-ID {}, which the table gives to {}: give it another one (lss set-id)",
                id.get(),
                address::text(&address)
            );
            self.hold(address, why);
            return Ok(());
        }
        self.give(session, (id, address), before, None).map(drop)
    }

    /// Gives node-IDs to the boards without one.
    fn blank(&mut self, session: &mut Session<'_>) -> Result<(), Failure> {
        let mut last: Option<Address> = None;
        // A Fastscan would find a board that stays as it is again and again.
        while self.held.is_empty() {
            let count = self.new.len();
            session
                .progress
                .say(|| format!("{count} boards have a node-ID now; looking for another"));
            let scan = Fastscan::new();
            let scan = last.map_or(scan.clone(), |last| scan.after_slave(last));
            let Some(address) = session.carry_out(scan)? else { return Ok(()) };
            last = Some(address);
            self.selected(session, address)?;
        }
        loop {
            let mut rest = scan::blank(session)?;
            rest.retain(|address| !self.held.contains(address));
            let before = self.decided();
            for address in rest {
                self.found(session, address)?;
            }
            if self.decided() == before {
                return Ok(());
            }
        }
    }

    /// Gives a board without a node-ID one.
    fn found(&mut self, session: &mut Session<'_>, address: Address) -> Result<(), Failure> {
        match self.select(session, address)? {
            Some(None) => self.selected(session, address),
            _ => Ok(()),
        }
    }

    /// Gives the selected board without a node-ID one: that of the table, or a free one and an entry there.
    fn selected(&mut self, session: &mut Session<'_>, address: Address) -> Result<(), Failure> {
        let is_it = |entry: &&(NodeId, Address)| entry.1 == address;
        let text = address::text(&address);
        if let Some((id, _)) = self.new.iter().find(is_it) {
            self.hold(address, format!("board {text} has lost node-ID {} again", id.get()));
            return Ok(());
        }
        if let Some((id, _)) = self.entries().iter().find(is_it) {
            return self.known(session, *id, address, None);
        }
        // A board may have come since.
        self.taken.extend(session.bus.states.keys());
        let Some(id) = self.free(self.first.get()) else {
            let first = self.first.get();
            let why = format!("board {text} needs a node-ID, but none from {first} on is free");
            self.hold(address, why);
            return Ok(());
        };
        let draft = self.table.as_ref().map(|table| table.with(id, address)).transpose()?;
        self.give(session, (id, address), None, draft).map(drop)
    }

    /// Gives another node-ID to each new board whose node-ID a board has that came later; says who shares one still.
    fn part(&mut self, session: &mut Session<'_>) -> Result<(), Failure> {
        let nodes = nodes::nodes(session)?;
        self.taken.extend(nodes.keys().chain(session.bus.states.keys()));
        let mut is_moved = false;
        for (id, address) in self.new.clone() {
            let is_other = |number: &u32| *number != address.serial_number;
            let is_shared =
                nodes.get(&id.get()).is_some_and(|numbers| numbers.iter().any(is_other));
            let (true, Some(other)) = (is_shared, self.free(1)) else { continue };
            if self.select(session, address)?.is_none() {
                continue;
            }
            writeln!(session.out, "another board came with node-ID {}", id.get())?;
            is_moved |= self.give(session, (other, address), Some(id), None)?;
            // The other one has it.
            self.taken.insert(id.get());
        }
        let nodes = if is_moved { nodes::nodes(session)? } else { nodes };
        for (id, serial_numbers) in nodes {
            self.problems.extend(shared(session, id, &serial_numbers)?);
        }
        Ok(())
    }

    /// Gives node-IDs to boards that do not support Fastscan, found by identify remote slave: those of the products that
    /// the table or this run knows. Returns whether there were any.
    fn without_fastscan(&mut self, session: &mut Session<'_>) -> Result<bool, Failure> {
        let known = self.entries().into_iter().chain(self.new.iter().copied());
        let products: BTreeSet<(u32, u32)> =
            known.map(|(_, address)| (address.vendor_id, address.product_code)).collect();
        let before = self.new.len();
        for (vendor_id, product_code) in products {
            let mut within = Identify::product(vendor_id, product_code);
            session.progress.say(|| format!("identifying boards of product {product_code:08X}"));
            while let Some(address) = session.carry_out(Find::new(within.clone()))? {
                self.found(session, address)?;
                let Some(next) = address.serial_number.checked_add(1) else { break };
                within.serial_numbers = next..=u32::MAX;
            }
        }
        Ok(self.new.len() > before)
    }

    /// Gives node-IDs to boards that a person plugs in one after the other, and says which it is.
    fn one_at_a_time(&mut self, session: &mut Session<'_>) -> Result<(), Failure> {
        let mut until = session.bus.time();
        let mut told = Vec::new();
        let mut is_any = false;
        let mut is_next = true;
        loop {
            if is_next {
                until = session.bus.time() + HANDS;
                session.bus.take_unasked();
                session.progress.clear();
                let seconds = HANDS.as_secs();
                writeln!(session.out, "plug in the next board, within {seconds} s; Enter ends")?;
                session.out.flush()?;
            }
            session.bus.pass(LOOK)?;
            let is_over = session.bus.time() >= until;
            if is_over || session.person.answer(|| Ok::<_, Failure>(false))?.is_some() {
                break;
            }
            is_next = self.named(session)?;
            let mut blank = scan::blank(session)?;
            // One that was pulled out may be tried again.
            self.held.retain(|address| blank.contains(address));
            blank.retain(|address| !self.held.contains(address));
            match blank[..] {
                [address] => {
                    let before = self.decided();
                    self.found(session, address)?;
                    self.tell(session)?;
                    is_next |= self.decided() != before;
                }
                [_, ..] if blank != told => {
                    let boards: Vec<String> = blank.iter().map(address::text).collect();
                    let boards = boards.join(", ");
                    writeln!(
                        session.out,
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
    fn named(&mut self, session: &mut Session<'_>) -> Result<bool, Failure> {
        let booted = |frame: &Frame| match (frame.cob_id(), frame.data()) {
            (id @ 0x701..=0x77F, [0]) => Some((id & 0x7F) as u8),
            _ => None,
        };
        let unasked = session.bus.take_unasked();
        let ids: BTreeSet<u8> =
            unasked.iter().filter_map(|received| booted(&received.frame)).collect();
        for id in &ids {
            let numbers = nodes::serial_numbers(session, *id)?;
            self.taken.insert(*id);
            for row in rows::node(session, *id, &numbers)? {
                let text = row.lss_address.as_ref().map_or("-".into(), address::text);
                writeln!(session.out, "node {id}  {text}  has this node-ID already")?;
            }
        }
        Ok(!ids.is_empty())
    }
}

fn as_in_the_table(session: &mut Session<'_>, id: NodeId, address: Address) -> Result<(), Failure> {
    session.progress.clear();
    writeln!(session.out, "node {}  {}  as in the table", id.get(), address::text(&address))?;
    Ok(())
}

/// The words for a node-ID that these nodes have.
fn shared(
    session: &mut Session<'_>,
    id: u8,
    serial_numbers: &[u32],
) -> Result<Option<String>, Failure> {
    if serial_numbers.len() < 2 {
        return Ok(None);
    }
    let twins = rows::twins(&rows::node(session, id, serial_numbers)?).pop();
    let words = || {
        format!(
            "{} boards have node-ID {id}, with the serial numbers {}: give all but one another (lss set-id --reset)",
            serial_numbers.len(),
            address::parts(serial_numbers)
        )
    };
    Ok(Some(twins.unwrap_or_else(words)))
}
