//! `lss apply`: brings a network to the state that files describe, and says before what it is going to do.

use std::{
    fs,
    path::{Path, PathBuf},
};

use canopen_node::{BitRate, NodeId};

use crate::{
    address,
    arguments::Apply,
    commands::set_rate,
    failure::Failure,
    plan::{
        dcf,
        differences::{Plan, counted, print_unknown},
        files::Files,
        found::{self, Found},
        node_ids::{Fate, NodeIds},
        values::{self, Values},
    },
    session::Session,
};

/// The switch delay of another bit rate in ms, as that of `lss set-rate`.
const SWITCH_DELAY: u16 = 500;

/// Prints the plan, and carries it out. The user has `given` the bit rate at which the boards are now.
pub fn apply(
    session: &mut Session<'_>,
    given: Option<BitRate>,
    arguments: &Apply,
) -> Result<(), Failure> {
    // Wrong files do not concern the boards.
    session.all_wait = true;
    let files = Files::read(&arguments.files)?;
    session.all_wait = false;
    let mark = Mark::beside(&arguments.files[0]);
    let stores_again = mark.is_there();
    found::open(session, given, files.bit_rate)?;
    let mut found = found::boards(session, &files, arguments.plan)?;
    if found.places.iter().all(Option::is_none) && found.unknown.is_empty() {
        return Err(Failure::nobody(session.bus.rate()));
    }
    let trusts_stamps = !stores_again && !arguments.full;
    let values = values(session, &files, &mut found, trusts_stamps)?;
    session.progress.clear();
    let plan = Plan::new(&files, &found, &values, session.bus.rate(), stores_again);
    match arguments.json {
        true => plan.print_json(session)?,
        false => plan.print(session)?,
    }
    if !arguments.plan && plan.differs() {
        mark.set()?;
        let before = found.problems.clone();
        let problems = work(session, &files, &mut found, stores_again, trusts_stamps);
        let problems = match problems {
            Err(failure @ Failure::Stop(_)) => {
                session.progress.clear();
                writeln!(session.out, "not finished: start `lss apply` again, and it goes on")?;
                return Err(failure);
            }
            problems => problems?,
        };
        session.progress.clear();
        match problems.is_empty() {
            true => mark.remove(),
            // Some of them are known since the plan.
            false => found
                .problems
                .extend(problems.into_iter().filter(|problem| !before.contains(problem))),
        }
    }
    if let Some(folder) = &arguments.write_dcf {
        write_dcfs(session, &files, &mut found, folder, arguments.json)?;
    }
    match (found.problems.is_empty(), arguments.plan && plan.differs()) {
        (true, false) => {
            if !arguments.json {
                writeln!(session.out, "the network is as the files say")?;
            }
            Ok(())
        }
        (true, true) => Err(Failure::Refused(format!(
            "{} differ from the files: `lss apply` without --plan changes them",
            plan.count()
        ))),
        (false, _) => Err(Failure::Refused(found.problems.join("\n"))),
    }
}

/// Compares the values of the nodes that can be asked; those of the others are not known yet.
fn values(
    session: &mut Session<'_>,
    files: &Files,
    found: &mut Found,
    trusts_stamps: bool,
) -> Result<Vec<Option<Values>>, Failure> {
    let mut all = Vec::new();
    for (node, place) in files.nodes.iter().zip(&found.places) {
        let id = place.filter(|place| !place.is_shared).and_then(|place| place.id);
        let Some(id) = id else {
            all.push(None);
            continue;
        };
        match values::compare(session, id, node, trusts_stamps) {
            Ok(mut values) => {
                values.changes.retain_mut(|change| change.remains(node, id));
                all.push(Some(values));
            }
            Err(failure) => {
                found.problems.push(format!("{}: {}", node.words(), failure.of_board()?));
                all.push(None);
            }
        }
    }
    Ok(all)
}

/// Carries the plan out: the node-IDs, the bit rate, the values. Returns what was left undone, in words.
fn work(
    session: &mut Session<'_>,
    files: &Files,
    found: &mut Found,
    stores_again: bool,
    trusts_stamps: bool,
) -> Result<Vec<String>, Failure> {
    let known = std::mem::take(&mut found.problems);
    let before: Vec<_> =
        found.places.iter().map(|place| place.and_then(|place| place.id)).collect();
    let rate = files.bit_rate.filter(|rate| *rate == session.bus.rate());
    give_node_ids(session, files, found, rate, stores_again)?;
    found.unshare();
    for row in found::late(session, found)? {
        print_unknown(&mut *session.out, &row)?;
    }
    if let Some(rate) = files.bit_rate.filter(|rate| *rate != session.bus.rate()) {
        match found.places.iter().all(Option::is_some) {
            true => set_rate(session, rate, SWITCH_DELAY)?,
            false => found.problems.push(format!(
                "the bit rate stays {}, since a board is missing: it would be lost at {rate}",
                session.bus.rate()
            )),
        }
        session.bus.hold_interrupt(false);
    }
    let mut problems = std::mem::replace(&mut found.problems, known);
    for ((node, place), before) in files.nodes.iter().zip(&found.places).zip(before) {
        let Some((place, id)) = place.and_then(|place| Some((place, place.id?))) else { continue };
        // It still waits for its node-ID.
        if id != node.id || place.is_shared {
            continue;
        }
        let is_new = before != Some(id);
        let outcome = values::apply(session, id, &place.address, node, stores_again, trusts_stamps);
        let done = match outcome {
            Ok(done) => done,
            Err(failure) => {
                problems.push(format!("{}: {}", node.words(), failure.of_board()?));
                continue;
            }
        };
        let mut words = Vec::new();
        if is_new || stores_again {
            words.push("node-ID stored".to_owned());
        }
        match (done.written, done.is_stored) {
            (0, false) => {}
            (0, true) => words.push("values stored".into()),
            (count, true) => words.push(format!("{} written and stored", counted(count, "value"))),
            (count, false) => words.push(format!(
                "{} written, until the next reset: it cannot store them",
                counted(count, "value")
            )),
        }
        if is_new || done.is_verified {
            words.push("verified by a reset".into());
        }
        if done.was_operational {
            words.push("pre-operational since the reset".into());
        }
        if !words.is_empty() {
            let address = address::text(&place.address);
            writeln!(session.out, "{}  {address}  {}", node.words(), words.join(", "))?;
        }
    }
    Ok(problems)
}

/// Gives each board of the files its node-ID, and lets it store the bit `rate`, too, if it is known.
fn give_node_ids(
    session: &mut Session<'_>,
    files: &Files,
    found: &mut Found,
    rate: Option<BitRate>,
    stores_again: bool,
) -> Result<(), Failure> {
    let mut node_ids = NodeIds::new(session, found, rate);
    let Found { places, problems, .. } = found;
    let ids: Vec<NodeId> = files.nodes.iter().map(|node| node.id).collect();
    node_ids.give_all(session, &ids, places, stores_again, |_, number, address, fate| {
        let words = files.nodes[number].words();
        match fate {
            Fate::Given { .. } => {}
            Fate::Taken => problems.push(format!(
                "{words}: another board has node-ID {}. Give it another one: lss set-id ID --reset --store --address \
                 V:P:R:S",
                ids[number].get()
            )),
            Fate::Failed(why) => problems.push(format!(
                "{words}: {why}. Board {}: is it still there, and not locked while NMT operational? A further run goes on",
                address::text(&address)
            )),
        }
        Ok(())
    })
}

fn write_dcfs(
    session: &mut Session<'_>,
    files: &Files,
    found: &mut Found,
    folder: &Path,
    is_quiet: bool,
) -> Result<(), Failure> {
    for (node, place) in files.nodes.iter().zip(&found.places) {
        let place = place.filter(|place| !place.is_shared);
        let Some((address, id)) = place.and_then(|place| Some((place.address, place.id?))) else {
            continue;
        };
        if node.sheet.is_none() && !is_quiet {
            let words = node.words();
            writeln!(session.out, "no DCF of {words}: the files have no data sheet of it (eds)")?;
        }
        let Some(sheet) = &node.sheet else { continue };
        match dcf::write(session, folder, node, sheet, &address, id) {
            Ok(_) if is_quiet => {}
            Ok(file) => writeln!(session.out, "{file}")?,
            Err(failure) => found.problems.push(failure.of_board()?),
        }
    }
    Ok(())
}

/// A file beside the first one that is there while the work is not finished: the next run trusts nothing that may not
/// be stored.
struct Mark(PathBuf);

impl Mark {
    fn beside(path: &Path) -> Self {
        let mut name = path.file_name().unwrap_or_default().to_owned();
        name.push(".unfinished");
        Self(path.with_file_name(name))
    }

    fn is_there(&self) -> bool {
        self.0.exists()
    }

    fn set(&self) -> Result<(), Failure> {
        let text = "A run of `lss apply` has not finished. The next one lets all boards store again, and goes on.\n";
        let written = fs::write(&self.0, text);
        written.map_err(|error| {
            Failure::Refused(format!(
                "cannot write {}: {error}. Nothing was changed",
                self.0.display()
            ))
        })
    }

    fn remove(&self) {
        // If it stays, the next run stores again.
        let _ = fs::remove_file(&self.0);
    }
}
