//! `lss apply`: brings a network to the state that files describe, and says before what it is going to do.

use std::{fs, path::Path};

use canopen_node::{BitRate, NodeId};

use crate::{
    address::counted,
    arguments::Apply,
    commands::set_rate,
    failure::{Failure, Result},
    plan::{
        dcf,
        differences::{Plan, print_unknown},
        files::Files,
        found::{self, Found, Place},
        node_ids::{Fate, NodeIds},
        table::beside,
        values::{self, Done, Manner, Values},
    },
    session::Session,
};

/// The switch delay of another bit rate in ms, as that of `lss set-rate`.
const SWITCH_DELAY: u16 = 500;

/// What the name of the file ends with that says that a run has not finished, and its content.
const UNFINISHED: &str = ".unfinished";
const MARK: &str = "A run of `lss apply` has not finished. The next one lets all boards store again, and goes on.\n";

/// Prints the plan, and carries it out. The user has `given` the bit rate at which the boards are now.
pub fn apply(session: &mut Session, given: Option<BitRate>, arguments: &Apply) -> Result {
    // Wrong files do not concern the boards.
    session.all_wait = true;
    let files = Files::read(&arguments.files)?;
    session.all_wait = false;
    // Beside the first file as long as the work is not finished: the next run trusts nothing that may not be stored.
    let mark = beside(&arguments.files[0], UNFINISHED);
    let stores_again = mark.exists();
    found::open(session, given, files.bit_rate)?;
    let found = found::boards(session, &files, arguments.plan)?;
    if found.places.iter().all(Option::is_none) && found.unknown.is_empty() {
        return Err(Failure::nobody(session.bus.rate()));
    }
    let manner = Manner {
        stores_again,
        trusts_stamps: !stores_again && !arguments.full,
        keeps_state: arguments.keep_state,
    };
    let mut run = Run { session, files, found, manner };
    let values = run.compare()?;
    run.session.progress.clear();
    let rate = run.session.bus.rate();
    let plan = Plan::new(&run.files, &run.found, &values, rate, stores_again);
    run.session.found(&plan)?;
    plan.print(run.session)?;
    if !arguments.plan && plan.differs() {
        fs::write(&mark, MARK).map_err(|error| {
            let mark = mark.display();
            Failure::Refused(format!("cannot write {mark}: {error}. Nothing was changed"))
        })?;
        let known = run.found.problems.len();
        let outcome = run.carry_out();
        run.session.progress.clear();
        if let Err(Failure::Stop(_)) = outcome {
            writeln!(run.session.out, "not finished: start `lss apply` again, and it goes on")?;
        }
        outcome?;
        let new = run.found.problems.split_off(known);
        if new.is_empty() {
            // If it stays, the next run stores again.
            let _ = fs::remove_file(&mark);
        }
        // Some of them are known since the plan.
        let is_told = |problem: &String| run.found.problems.contains(problem);
        let new: Vec<String> = new.into_iter().filter(|problem| !is_told(problem)).collect();
        run.found.problems.extend(new);
    }
    run.found.problems.append(&mut run.found.left_out);
    if let Some(folder) = &arguments.write_dcf {
        run.write_dcfs(folder)?;
    }
    Failure::of(&run.found.problems)?;
    if arguments.plan && plan.differs() {
        return Err(Failure::Refused(format!(
            "{} differ from the files: `lss apply` without --plan changes them",
            plan.count()
        )));
    }
    Ok(writeln!(run.session.out, "the network is as the files say")?)
}

/// A run, with what is wanted and what is found.
struct Run<'s> {
    session: &'s mut Session,
    files: Files,
    found: Found,
    manner: Manner,
}

impl Run<'_> {
    /// Compares the values of the nodes that can be asked.
    fn compare(&mut self) -> Result<Vec<Values>> {
        let mut all = Vec::new();
        for (node, place) in self.files.nodes.iter().zip(self.found.places.clone()) {
            let mut values = Values::not_compared(node);
            if let Some(Place { id: Some(id), is_shared: false, .. }) = place {
                match values::compare(self.session, id, node, self.manner.trusts_stamps) {
                    Ok(compared) => values = compared,
                    Err(failure) => self.found.problems.push(node.failed(failure)?),
                }
                values.changes.retain_mut(|change| change.remains(node, id));
                self.found.leave_out(node, &values.left_out);
            }
            all.push(values);
        }
        Ok(all)
    }

    /// Carries the plan out: the node-IDs, the bit rate, the values. What is left undone is among the problems.
    fn carry_out(&mut self) -> Result {
        let before: Vec<_> =
            self.found.places.iter().map(|place| place.and_then(|place| place.id)).collect();
        let rate = self.session.bus.rate();
        self.give_node_ids(self.files.bit_rate.filter(|wanted| *wanted == rate))?;
        self.found.unshare();
        for row in found::late(self.session, &mut self.found)? {
            print_unknown(&mut *self.session.out, &row)?;
        }
        if let Some(wanted) = self.files.bit_rate.filter(|wanted| *wanted != rate) {
            match self.found.places.iter().all(Option::is_some) {
                true => set_rate(self.session, wanted, SWITCH_DELAY)?,
                false => self.found.problems.push(format!(
                    "the bit rate stays {rate}, since a board is missing: it would be lost at {wanted}"
                )),
            }
            self.session.bus.hold_interrupt(false);
        }
        let places = self.found.places.clone();
        for ((node, place), before) in self.files.nodes.iter().zip(places).zip(before) {
            // Another one still waits for its node-ID.
            let Some(Place { address, id: Some(id), is_shared: false }) = place else { continue };
            if id != node.id {
                continue;
            }
            match values::apply(self.session, id, &address, node, self.manner) {
                Ok(done) => {
                    self.found.leave_out(node, &done.left_out);
                    let words = words(&done, before != Some(id), self.manner.stores_again);
                    if !words.is_empty() {
                        let words = words.join(", ");
                        writeln!(self.session.out, "{}  {address}  {words}", node.words())?;
                    }
                }
                Err(failure) => self.found.problems.push(node.failed(failure)?),
            }
        }
        Ok(())
    }

    /// Gives each board of the files its node-ID, and lets it store the bit `rate`, too, if it is known.
    fn give_node_ids(&mut self, rate: Option<BitRate>) -> Result {
        let nodes = &self.files.nodes;
        let mut node_ids = NodeIds::new(self.session, &self.found, rate);
        let Found { places, problems, .. } = &mut self.found;
        let ids: Vec<NodeId> = nodes.iter().map(|node| node.id).collect();
        let tell = |_: &mut Session, number: usize, address, fate| {
            let words = nodes[number].words();
            match fate {
                Fate::Had | Fate::Given { .. } => {}
                Fate::Taken => problems.push(format!(
                    "{words}: another board has node-ID {}. Give it another one: lss set-id ID --reset --store --address \
                     V:P:R:S",
                    ids[number]
                )),
                Fate::Failed(why) => problems.push(format!(
                    "{words}: {why}. Board {address}: is it still there, and not locked while NMT operational? A further run \
                     goes on"
                )),
            }
            Ok(())
        };
        node_ids.give_all(self.session, &ids, places, self.manner.stores_again, tell)
    }

    fn write_dcfs(&mut self, folder: &Path) -> Result {
        for (node, place) in self.files.nodes.iter().zip(&self.found.places) {
            let Some(Place { address, id: Some(id), is_shared: false }) = place else { continue };
            let Some(sheet) = &node.sheet else {
                let words = node.words();
                writeln!(
                    self.session.out,
                    "no DCF of {words}: the files have no data sheet of it (eds)"
                )?;
                continue;
            };
            match dcf::write(self.session, folder, node, sheet, address, *id) {
                Ok(file) => writeln!(self.session.out, "{file}")?,
                Err(failure) => self.found.problems.push(failure.of_board()?),
            }
        }
        Ok(())
    }
}

/// What was done with a board.
fn words(done: &Done, is_new: bool, stores_again: bool) -> Vec<String> {
    let mut words = Vec::new();
    if is_new || stores_again {
        words.push("node-ID stored".to_owned());
    }
    let count = counted(done.written, "value");
    match (done.written, done.is_stored) {
        (0, false) => {}
        (0, true) => words.push("values stored".into()),
        (_, true) => words.push(format!("{count} written and stored")),
        (_, false) => {
            words.push(format!("{count} written, until the next reset: it cannot store them"));
        }
    }
    if is_new || done.is_verified {
        words.push("verified by a reset".into());
    }
    if done.is_pre_operational {
        let since = if done.is_verified { "since the reset" } else { "now: `lss start` starts it" };
        words.push(format!("pre-operational {since}"));
    }
    words
}
