//! `lss find`: the bit rate of the network, and who is there.

use std::{collections::BTreeMap, time::Duration};

use can_bus::explain::explain;
use canopen_node::{BitRate, lss::Request};

use crate::{
    failure::Failure,
    scan,
    session::{DEFAULT_RATE, Session},
};

/// The wait for a frame on a bus where nodes send heartbeats, in general one a second.
const HEARTBEAT: Duration = Duration::from_millis(1150);

/// The time in which a frame is repeated at any bit rate.
const REPETITION: Duration = Duration::from_millis(20);

/// What a bit rate showed.
#[derive(Default)]
struct Sight {
    /// The frames heard, in words, with their number.
    heard: BTreeMap<String, usize>,
    is_blank_there: bool,
    /// The node-IDs that answer.
    nodes: Vec<u8>,
    has_errors: bool,
    /// Somebody acknowledges the adapter's frames, as far as the adapter can tell.
    is_acknowledged: bool,
}

/// Finds the bit rate of the network: by listening to all bit rates first, then by questions that change no state. The
/// adapter was expected to be at `expected`.
pub fn find(session: &mut Session<'_>, expected: BitRate) -> Result<(), Failure> {
    writeln!(session.out, "adapter: {}", session.bus.description())?;
    let rates: Vec<BitRate> = match session.bus.fixed_rate() {
        Some(rate) => vec![rate],
        None => {
            // That of new boards first: some look for the network's bit rate, and could follow a question to a wrong one.
            let first = [DEFAULT_RATE, expected];
            let others = BitRate::ALL.into_iter().filter(|rate| !first.contains(rate));
            let mut rates: Vec<BitRate> = first.into_iter().chain(others).collect();
            rates.dedup();
            rates
        }
    };
    let mut has_signals = false;
    let mut heard_at = None;
    for &rate in &rates {
        session.progress.say(|| format!("listening at {rate}"));
        let sight = listen(session, rate)?;
        has_signals |= sight.has_errors || !sight.heard.is_empty();
        if !sight.heard.is_empty() {
            heard_at = Some((rate, sight));
            break;
        }
    }
    if let Some((rate, mut sight)) = heard_at {
        ask(session, rate, &mut sight)?;
        return tell(session, rate, expected, &sight);
    }
    let mut has_errors = false;
    for &rate in &rates {
        session.progress.say(|| format!("asking at {rate}"));
        let mut sight = Sight::default();
        ask(session, rate, &mut sight)?;
        if sight.is_blank_there || !sight.nodes.is_empty() || sight.is_acknowledged {
            return tell(session, rate, expected, &sight);
        }
        has_errors |= sight.has_errors;
    }
    Err(Failure::NoAnswer(silence(has_signals, has_errors)))
}

/// Listens without a sign of life on the bus.
fn listen(session: &mut Session<'_>, rate: BitRate) -> Result<Sight, Failure> {
    session.bus.listen(rate)?;
    let mut sight = Sight::default();
    for received in session.bus.collect(HEARTBEAT)? {
        let words = explain(received.frame.cob_id(), received.frame.data());
        *sight.heard.entry(words).or_default() += 1;
    }
    sight.has_errors = session.bus.status()?.is_some_and(|status| status.has_errors);
    Ok(sight)
}

/// Asks by identify non-configured remote slave, and each node for its serial number if somebody acknowledges.
fn ask(session: &mut Session<'_>, rate: BitRate, sight: &mut Sight) -> Result<(), Failure> {
    session.bus.open(rate)?;
    // Shortly, since at a wrong bit rate the adapter repeats its frame and disturbs the bus.
    sight.is_blank_there = session.bus.probe(Request::IdentifyNonConfigured)?.is_some();
    let mut status = session.bus.status()?;
    if status.is_some_and(|status| status.has_errors) {
        // A frame that nobody acknowledges is repeated without end.
        session.bus.pass(REPETITION)?;
        status = session.bus.status()?;
    }
    sight.has_errors = status.is_some_and(|status| status.has_errors || status.is_error_passive);
    sight.is_acknowledged = status.is_some() && !sight.has_errors;
    if !sight.has_errors || sight.is_blank_there || !sight.heard.is_empty() {
        sight.nodes = scan::nodes(session)?.into_keys().collect();
    }
    Ok(())
}

fn tell(
    session: &mut Session<'_>,
    rate: BitRate,
    expected: BitRate,
    sight: &Sight,
) -> Result<(), Failure> {
    let out = &mut *session.out;
    match rate == expected {
        true => writeln!(out, "the network runs at {rate}")?,
        false => writeln!(
            out,
            "the network runs at {rate}, and not at {expected}: use --bit-rate {}",
            rate.kbit_per_s()
        )?,
    }
    for (words, count) in &sight.heard {
        writeln!(out, "heard: {words} ({count})")?;
    }
    if !sight.nodes.is_empty() {
        let nodes: Vec<String> = sight.nodes.iter().map(u8::to_string).collect();
        writeln!(out, "answers to SDO: node {}", nodes.join(", "))?;
    }
    if sight.is_blank_there {
        writeln!(out, "answers to LSS: at least one board without a node-ID")?;
    }
    if !sight.is_blank_there && sight.nodes.is_empty() {
        writeln!(out, "nobody answers to SDO or LSS; somebody takes part in the bus")?;
    }
    Ok(())
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
