//! `lss set-rate`: another bit rate for the whole network, or for nobody.

use can_bus::bus::Masters;
use canopen_node::{
    BitRate,
    lss::{Address, Request},
};
use lss_master::{Member, SelectAlone, SwitchBitRate};

use crate::{
    address,
    commands::list,
    failure::{self, Failure},
    session::Session,
};

/// Switches all boards to another bit rate and stores it. If one does not come, all go back. At the bit rate that the
/// network has already, a board that came there by listening makes it its own.
pub fn set_rate(session: &mut Session<'_>, to: BitRate, delay_ms: u16) -> Result<(), Failure> {
    let from = session.bus.rate();
    if session.bus.fixed_rate().is_some() {
        return Err(Failure::Refused(
            "the bit rate of this interface must stay: name it without @KBIT".into(),
        ));
    }
    let mut members = plan(session)?;
    session.progress.clear();
    writeln!(session.out, "plan: {} boards from {from} to {to}", members.len())?;
    session.bus.check_interrupt()?;
    // Halfway the boards could not be found again: neither Ctrl-C nor another master ends the switch.
    session.bus.hold_interrupt(true);
    session.bus.mind(Masters::None);
    session.progress.say(|| format!("switching to {to}"));
    let switched = session.bus.carry_out(SwitchBitRate::new(&mut members, from, to, delay_ms))?;
    if switched.is_err() && session.bus.rate() == from {
        return Err(Failure::Refused(format!("{}; nothing was switched", problems(&members))));
    }
    if switched.is_err() {
        let why = format!("at {to}: {}", problems(&members));
        return go_back(session, &members, (to, from), delay_ms, &why);
    }
    session.bus.hold_interrupt(false);
    let is_interrupted = session.bus.check_interrupt();
    session.bus.hold_interrupt(true);
    if let Err(stop) = is_interrupted {
        let outcome = go_back(session, &members, (to, from), delay_ms, "interrupted");
        if let Err(failure) = outcome {
            writeln!(session.out, "{failure}")?;
        }
        return Err(stop.into());
    }
    for number in 0..members.len() {
        let Member { address, .. } = members[number];
        session.progress.say(|| format!("storing {} of {}", number + 1, members.len()));
        if let Err(failure) = store(session, address) {
            let why = format!("board {}: {failure}", address::text(&address));
            let stored: Vec<Address> =
                members[..=number].iter().map(|member| member.address).collect();
            let outcome = go_back(session, &members, (to, from), delay_ms, &why);
            // The last one may have stored, too, and its answer may be lost.
            for address in stored {
                let _ = store(session, address);
            }
            return outcome;
        }
    }
    writeln!(session.out, "all {} boards answer at {to} and have stored it", members.len())?;
    Ok(())
}

/// The boards of the network, each of which can be selected.
fn plan(session: &mut Session<'_>) -> Result<Vec<Member>, Failure> {
    let mut members = Vec::new();
    for row in list::rows(session)? {
        let Some(address) = row.lss_address else {
            return Err(Failure::Refused(format!(
                "{} does not tell its LSS address: it cannot be switched with the others. Take it off the bus",
                row.node_id.map_or("a board without a node-ID".into(), |id| format!("node {id}"))
            )));
        };
        members.push(Member::new(address));
    }
    match members.is_empty() {
        true => Err(Failure::nobody(session.bus.rate())),
        false => Ok(members),
    }
}

/// Takes all boards that came back to the old bit rate. Always fails, with `why` and with who is missing.
fn go_back(
    session: &mut Session<'_>,
    members: &[Member],
    (from, to): (BitRate, BitRate),
    delay_ms: u16,
    why: &str,
) -> Result<(), Failure> {
    let mut rest = members.to_vec();
    rest.retain(|member| member.outcome.is_ok());
    // Another one may be lost on the way: the others do not wait for it.
    while !rest.is_empty() {
        let _ = session.bus.carry_out(SwitchBitRate::new(&mut rest, from, to, delay_ms))?;
        if session.bus.rate() == to {
            break;
        }
        rest.retain(|member| member.outcome.is_ok());
    }
    session.bus.open(to)?;
    let mut missing = Vec::new();
    for Member { address, .. } in members {
        // One that did not follow may still have the new bit rate pending.
        let index = Request::ConfigureBitTiming { table: 0, index: to.index() };
        let back =
            session.carry_out(SelectAlone::new(*address)).and_then(|()| session.carry_out(index));
        if back.is_err() {
            missing.push(address::text(address));
        }
    }
    let there = members.len() - missing.len();
    let mut words = format!("{why}. Nothing is stored; {there} boards are at {to} again");
    if !missing.is_empty() {
        words += &format!(", missing: {}", missing.join(", "));
    }
    Err(Failure::Refused(words))
}

fn store(session: &mut Session<'_>, address: Address) -> Result<(), Failure> {
    session.carry_out(SelectAlone::new(address))?;
    session.carry_out(Request::StoreConfiguration)
}

/// Who failed, and why.
fn problems(members: &[Member]) -> String {
    let failed = members.iter().filter_map(|member| {
        let words = failure::words(member.outcome.err()?);
        Some(format!("board {}: {words}", address::text(&member.address)))
    });
    failed.collect::<Vec<_>>().join("; ")
}
