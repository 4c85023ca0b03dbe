//! `lss find`: the bit rate of the network, and who answers.

use can_bus::stop::Stop;
use canopen_node::BitRate;
use serde_json::Value;

use crate::{
    address,
    failure::{Failure, Result},
    network::rate::{self, Sight},
    session::{DEFAULT_RATE, Session},
};

/// What a silent network gets to read.
const QUIET: &str = "no frame at any bit rate. New boards are silent, at 125 kbit/s: `lss list` shows them. For \
    other bit rates, `lss find --ask` asks at each of them. Both are right for boards that only wait to be asked, and \
    wrong for a network that runs and was silent for these seconds: a question at another bit rate disturbs it for a \
    tenth of a second, and a node that sends then may switch itself off (bus-off)";

/// What boards at different bit rates get to read.
const MIXED: &str =
    "boards at different bit rates disturb each other: leave those of one bit rate on the bus";

/// Finds the bit rate of the network: by listening to all bit rates, and if it is silent and `asks`, by questions that
/// change no state. The adapter was expected to be at `expected`.
pub fn find(session: &mut Session, expected: BitRate, asks: bool) -> Result {
    writeln!(session.out, "adapter: {}", session.bus.description())?;
    let mut search = Search { session, expected, lacking: Vec::new(), networks: Vec::new() };
    let outcome = search.run(asks);
    let Search { lacking, networks, .. } = search;
    session.found(&serde_json::json!({ "networks": networks }))?;
    if !lacking.is_empty() {
        let lacking = address::list(lacking);
        writeln!(session.out, "this adapter does not have {lacking}: nobody was looked for there")?;
    }
    outcome
}

/// A search, and what it has found.
struct Search<'s> {
    session: &'s mut Session,
    expected: BitRate,
    /// The bit rates that the adapter does not have.
    lacking: Vec<BitRate>,
    /// What was told, for JSON.
    networks: Vec<Value>,
}

impl Search<'_> {
    fn run(&mut self, asks: bool) -> Result {
        let mut rates: Vec<BitRate> = match self.session.bus.fixed_rate() {
            Some(rate) => vec![rate],
            None => {
                // The most likely ones first, where boards without an error to search from answer at once.
                let first = [DEFAULT_RATE, self.expected];
                let others = BitRate::ALL.into_iter().filter(|rate| !first.contains(rate));
                let mut rates: Vec<BitRate> = first.into_iter().chain(others).collect();
                rates.dedup();
                rates
            }
        };
        let mut has_signals = false;
        let mut sights = Vec::new();
        for &rate in &rates {
            self.session.progress.say(|| format!("listening at {rate}"));
            let sight = match rate::listen(self.session, rate) {
                Err(Failure::Stop(Stop::NoBitRate(_))) => {
                    self.lacking.push(rate);
                    continue;
                }
                sight => sight?,
            };
            has_signals |= sight.has_errors;
            if !sight.heard.is_empty() {
                let has_errors = sight.has_errors;
                sights.push((rate, sight));
                // Errors may be the frames of boards at another bit rate.
                if !has_errors {
                    break;
                }
            }
        }
        if let [(rate, sight)] = &mut sights[..] {
            rate::ask(self.session, *rate, sight)?;
            rate::name(self.session, sight)?;
            return self.tell(*rate, sight);
        }
        // A question would disturb those at the other bit rates.
        for (rate, sight) in &sights {
            writeln!(self.session.out, "boards run at {rate}")?;
            self.tell_heard(*rate, sight)?;
        }
        if !sights.is_empty() {
            return Err(Failure::Refused(MIXED.into()));
        }
        if !asks {
            return Err(Failure::NoAnswer(QUIET.into()));
        }
        rates.retain(|rate| !self.lacking.contains(rate));
        let (answers, has_errors) = self.ask_at_all(&rates)?;
        for (rate, sight) in &answers {
            self.tell(*rate, sight)?;
        }
        match answers.len() {
            0 => Err(Failure::NoAnswer(silence(has_signals, has_errors))),
            1 => Ok(()),
            _ => Err(Failure::Refused(MIXED.into())),
        }
    }

    /// Asks at all bit rates; returns those at which somebody takes part, and whether there were errors.
    ///
    /// A board that looks for the bit rate of its network may follow a question to another one than its own. The question
    /// at its own takes it back, and from then on it stays. So each bit rate is asked, whatever answers before, and each
    /// with an answer once more. The adapter reports no error where somebody acknowledges; that is an answer only if it
    /// has reported errors at another bit rate.
    fn ask_at_all(&mut self, rates: &[BitRate]) -> Result<(Vec<(BitRate, Sight)>, bool)> {
        let mut has_errors = false;
        let mut sights = Vec::new();
        for &rate in rates {
            self.session.progress.say(|| format!("asking at {rate}"));
            let sight = rate::answers_at(self.session, rate)?;
            has_errors |= sight.has_errors;
            sights.push((rate, sight));
        }
        let takes_part = |sight: &Sight| sight.has_answer() || has_errors && sight.is_acknowledged;
        sights.retain(|(_, sight)| takes_part(sight));
        let mut answers = Vec::new();
        for (rate, _) in sights {
            self.session.progress.say(|| format!("asking at {rate} again"));
            let mut sight = rate::answers_at(self.session, rate)?;
            if takes_part(&sight) {
                rate::name(self.session, &mut sight)?;
                answers.push((rate, sight));
            }
        }
        Ok((answers, has_errors))
    }

    fn tell(&mut self, rate: BitRate, sight: &Sight) -> Result {
        let Self { expected, .. } = *self;
        match rate == expected {
            true => writeln!(self.session.out, "the network runs at {rate}")?,
            false => writeln!(
                self.session.out,
                "the network runs at {rate}, and not at {expected}: use --bit-rate {}",
                rate.kbit_per_s()
            )?,
        }
        self.tell_heard(rate, sight)?;
        let out = &mut self.session.out;
        if !sight.nodes.is_empty() {
            writeln!(out, "answers to SDO: node {}", address::list(&sight.nodes))?;
        }
        if sight.has_blank {
            writeln!(out, "answers to LSS: at least one board without a node-ID")?;
        }
        if !sight.has_blank && sight.nodes.is_empty() {
            writeln!(out, "nobody answers to SDO or LSS; somebody takes part in the bus")?;
        }
        Ok(())
    }

    fn tell_heard(&mut self, rate: BitRate, sight: &Sight) -> Result {
        self.networks.push(serde_json::json!({
            "bit_rate": rate.kbit_per_s(),
            "nodes": sight.nodes,
            "has_blank": sight.has_blank,
            "heard": sight.heard,
        }));
        for (words, count) in &sight.heard {
            writeln!(self.session.out, "heard: {words} ({count})")?;
        }
        Ok(())
    }
}

/// The words for a bus on which nobody takes part at any rate.
fn silence(has_signals: bool, has_errors: bool) -> String {
    let place = "60 ohm between CANH and CANL without power";
    match (has_signals, has_errors) {
        (true, _) => format!(
            "there are signals on the bus, but not one valid frame at any bit rate: does a node run at a rate that is not \
             CiA 301's? Are CANH and CANL swapped? Is a termination missing ({place} is right)?"
        ),
        (false, true) => format!(
            "nobody acknowledges at any bit rate. Has the board power? Are CANH, CANL and ground connected, with {place}?"
        ),
        (false, false) => format!(
            "no answer at any bit rate, and this adapter does not report whether anybody acknowledges. Has the board \
             power? Are CANH, CANL and ground connected, with {place}?"
        ),
    }
}
