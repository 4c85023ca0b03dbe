//! `lss set-rate`: another bit rate for the whole network, or for nobody.

use can_bus::{bus::Masters, stop::Stop};
use canopen_node::{
    BitRate,
    lss::{Address, Request},
};
use lss_master::{Member, SelectAlone, SwitchBitRate};

use crate::{
    address::{self, counted},
    failure::{self, Failure, Result},
    network::rows,
    session::Session,
};

/// Switches all boards to another bit rate and stores it. If one does not come, all go back. At the bit rate that the
/// network has already, a board that came there by listening makes it its own.
pub fn set_rate(session: &mut Session, to: BitRate, delay_ms: u16) -> Result {
    let from = session.bus.rate();
    if session.bus.fixed_rate().is_some() {
        return Err(Failure::Refused(
            "the bit rate of this interface must stay: name it without @KBIT".into(),
        ));
    }
    let members = plan(session)?;
    // The boards must not go where the adapter cannot follow.
    session.bus.listen(to)?;
    session.bus.open(from)?;
    session.progress.clear();
    writeln!(session.out, "plan: {} from {from} to {to}", counted(members.len(), "board"))?;
    session.bus.check_interrupt()?;
    // Halfway the boards could not be found again: neither Ctrl-C nor another master ends the switch.
    session.bus.hold_interrupt(true);
    session.bus.mind(Masters::LssAsInterrupt);
    let mut switch = Switch { members, from, to, delay_ms, stored: None, is_back: false };
    let outcome = switch.carry_out(session);
    match (outcome, interruption(session)) {
        (Err(Failure::Stop(Stop::AdapterGone(why))), _) => {
            Err(Stop::AdapterGone(format!("{why}. {}", switch.whereabouts())).into())
        }
        (Err(failure), Err(stop)) => {
            writeln!(session.out, "{failure}")?;
            Err(stop.into())
        }
        (Ok(()), Err(stop @ Stop::OtherMaster(_))) => Err(stop.into()),
        (outcome, _) => outcome,
    }
}

/// The Ctrl-C or the other master that waits.
fn interruption(session: &mut Session) -> Result<(), Stop> {
    session.bus.hold_interrupt(false);
    let interruption = session.bus.check_interrupt();
    session.bus.hold_interrupt(true);
    interruption
}

/// A switch of the whole network.
struct Switch {
    members: Vec<Member>,
    from: BitRate,
    to: BitRate,
    delay_ms: u16,
    /// The number of boards that have stored the new bit rate, once the first is about to.
    stored: Option<usize>,
    /// The boards go back to the old one.
    is_back: bool,
}

impl Switch {
    fn carry_out(&mut self, session: &mut Session) -> Result {
        let &mut Self { from, to, delay_ms, .. } = self;
        session.progress.say(|| format!("switching to {to}"));
        let switched =
            session.bus.carry_out(SwitchBitRate::new(&mut self.members, from, to, delay_ms))?;
        if switched.is_err() && session.bus.rate() == from {
            let why = problems(&self.members);
            return Err(Failure::Refused(format!("{why}; nothing was switched")));
        }
        if switched.is_err() {
            let why = format!("at {to}: {}", problems(&self.members));
            return self.go_back(session, &why);
        }
        if let Err(stop) = interruption(session) {
            let is_other_master = matches!(stop, Stop::OtherMaster(_));
            let why = if is_other_master { "another master" } else { "interrupted" };
            return self.go_back(session, why);
        }
        for number in 0..self.members.len() {
            self.stored = Some(number);
            let Member { address, .. } = self.members[number];
            session.progress.say(|| format!("storing {} of {}", number + 1, self.members.len()));
            match store(session, address) {
                Err(failure @ Failure::Stop(_)) => return Err(failure),
                Err(failure) => {
                    let why = format!("board {address}: {failure}");
                    let outcome = self.go_back(session, &why);
                    // The last one may have stored, too, and its answer may be lost.
                    for member in &self.members[..=number] {
                        if let Err(stop @ Failure::Stop(_)) = store(session, member.address) {
                            return Err(stop);
                        }
                    }
                    return outcome;
                }
                Ok(()) => {}
            }
        }
        let boards = counted(self.members.len(), "board");
        writeln!(session.out, "{boards} answered at {to} and stored it")?;
        Ok(())
    }

    /// Takes all boards that came back to the old bit rate. Always fails, with `why` and with who is missing.
    fn go_back(&mut self, session: &mut Session, why: &str) -> Result {
        let &mut Self { from, to, delay_ms, .. } = self;
        self.is_back = true;
        let mut rest = self.members.clone();
        rest.retain(|member| member.outcome.is_ok());
        // Another one may be lost on the way: the others do not wait for it.
        while !rest.is_empty() {
            let _ = session.bus.carry_out(SwitchBitRate::new(&mut rest, to, from, delay_ms))?;
            if session.bus.rate() == from {
                break;
            }
            rest.retain(|member| member.outcome.is_ok());
        }
        session.bus.open(from)?;
        let mut missing = Vec::new();
        for Member { address, .. } in &self.members {
            // One that did not follow may still have the new bit rate pending.
            let index = Request::ConfigureBitTiming { table: 0, index: from.index() };
            let back = session
                .carry_out(SelectAlone::new(*address))
                .and_then(|()| session.carry_out(index));
            match back {
                Ok(()) => {}
                Err(stop @ Failure::Stop(_)) => return Err(stop),
                Err(_) => missing.push(*address),
            }
        }
        let boards = counted(self.members.len() - missing.len(), "board");
        let mut words = format!("{why}. Nothing is stored; at {from} again: {boards}");
        if !missing.is_empty() {
            words += &format!(", missing: {}", address::list(missing));
        }
        Err(Failure::Refused(words))
    }

    /// Where the boards may be when the adapter is gone.
    fn whereabouts(&self) -> String {
        let &Self { from, to, .. } = self;
        let all = self.members.len();
        match self.stored {
            None => format!(
                "Nothing is stored: the boards are at {from}, or at {to} until their power is off"
            ),
            Some(count) if self.is_back => format!(
                "The boards are at {from}, or at {to} until their power is off, and up to {} of {all} have stored {to}",
                count + 1
            ),
            Some(count) => {
                let rate = to.kbit_per_s();
                format!(
                    "All boards are at {to}, and at least {count} of {all} have stored it. While they have power, \
                     `lss set-rate {rate} --bit-rate {rate}` lets all store it"
                )
            }
        }
    }
}

/// The boards of the network, each of which can be selected.
fn plan(session: &mut Session) -> Result<Vec<Member>> {
    let mut problems = Vec::new();
    let rows = rows::rows(session, &mut problems)?;
    Failure::of(&problems)?;
    if let Some(twins) = rows::twins(&rows).pop() {
        return Err(Failure::Refused(twins));
    }
    let mut members = Vec::new();
    for row in rows {
        let Some(address) = row.lss_address else {
            return Err(Failure::Refused(format!(
                "{} does not tell its LSS address: it cannot be switched with the others. Take it off the bus",
                row.words()
            )));
        };
        members.push(Member::new(address));
    }
    match members.is_empty() {
        true => Err(Failure::nobody(session.bus.rate())),
        false => Ok(members),
    }
}

fn store(session: &mut Session, address: Address) -> Result {
    session.carry_out(SelectAlone::new(address))?;
    session.carry_out(Request::StoreConfiguration)
}

/// Who failed, and why.
fn problems(members: &[Member]) -> String {
    let failed = members.iter().filter_map(|member| {
        let words = failure::words(member.outcome.err()?);
        Some(format!("board {}: {words}", member.address))
    });
    failed.collect::<Vec<_>>().join("; ")
}
