//! The check that every board comes back after its power was away, with its node-ID and its bit rate.

use std::{collections::BTreeSet, time::Duration};

use canopen_node::lss::Request;

use crate::{
    address::{self, counted},
    failure::{Failure, Result},
    network::{nodes, rows, scan},
    session::{GLANCE, Session},
};

/// The wait for a person who switches the power, or plugs a board in.
pub const HANDS: Duration = Duration::from_secs(120);
/// The wait for the next board to come back.
const NEXT: Duration = Duration::from_secs(30);

/// Asks the person to switch the power off and on, and checks that each node boots up again and is the same board.
pub fn check(session: &mut Session) -> Result {
    session.carry_out(Request::SwitchToWaiting)?;
    let before = nodes::nodes(session)?;
    if before.is_empty() {
        return Err(Failure::NoAnswer("no node answers that could come back after power".into()));
    }
    session.bus.take_unasked();
    session.progress.clear();
    writeln!(
        session.out,
        "switch the power of all boards off, wait 2 s, and switch it on again ({} s are left)",
        HANDS.as_secs()
    )?;
    session.out.flush()?;
    let ids: BTreeSet<u8> = before.keys().copied().collect();
    let absent = wait(session, &ids)?;
    if absent == ids {
        return Err(Failure::Refused(format!(
            "no board has booted up within {} s: the power was not switched, and it is not known whether the boards keep \
             their node-IDs. All is stored",
            HANDS.as_secs()
        )));
    }
    session.progress.clear();
    let mut after = nodes::nodes(session)?;
    let mut problems = Vec::new();
    for (id, mut numbers) in before {
        let mut now = after.remove(&id).unwrap_or_default();
        numbers.sort_unstable();
        now.sort_unstable();
        let is_same = now == numbers;
        match (absent.contains(&id), is_same) {
            (is_absent, true) => {
                // A guest at a bit rate that it has found boots up with its first answer.
                let not_switched = || {
                    is_absent.then(|| {
                        format!("node {id} answers, but has not booted up: its power was not switched")
                    })
                };
                problems.extend(stored_rate(session, id)?.or_else(not_switched));
            }
            (_, false) if now.is_empty() => problems.push(format!(
                "node {id} has not come back within {} s: serial number {}. `lss find` looks for it at other bit rates",
                NEXT.as_secs(),
                address::parts(&numbers)
            )),
            (_, false) => problems.push(format!(
                "node {id} is another board after power: serial number {}, and it was {}",
                address::parts(&now),
                address::parts(&numbers)
            )),
        }
    }
    if !problems.is_empty() {
        for blank in scan::blank(session, &mut problems)? {
            problems.push(format!("board {blank} has no node-ID after power: it has not kept it"));
        }
        return Err(Failure::Refused(problems.join("\n")));
    }
    let rate = session.bus.rate();
    writeln!(session.out, "{} came back after power, at {rate}", counted(ids.len(), "board"))?;
    Ok(())
}

/// Waits for the boot-up of each node; returns those that do not come.
fn wait(session: &mut Session, ids: &BTreeSet<u8>) -> Result<BTreeSet<u8>> {
    let mut absent = ids.clone();
    let mut until = session.bus.time() + HANDS;
    while !absent.is_empty() && session.bus.time() < until {
        let back = ids.len() - absent.len();
        let all = counted(ids.len(), "board");
        session.progress.say(|| format!("waiting for the power: {back} of {all} back"));
        let received = session.bus.receive(until.min(session.bus.time() + GLANCE))?;
        let booted = received.and_then(|received| nodes::booted(&received.frame));
        if booted.is_some_and(|id| absent.remove(&id)) {
            until = session.bus.time() + NEXT;
        }
    }
    Ok(absent)
}

/// What is wrong with the stored bit rate of a node, if it tells.
fn stored_rate(session: &mut Session, id: u8) -> Result<Option<String>> {
    let rate = session.bus.rate().kbit_per_s();
    let home = rows::home_bit_rate(session, id)?.filter(|home| *home != 0 && *home != rate);
    Ok(home.map(|home| {
        format!("node {id} has stored {home} kbit/s, and the network runs at {rate}: `lss set-rate` is for all")
    }))
}
