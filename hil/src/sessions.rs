//! The sessions, in their order. Each finds the boards at the base rate in LSS waiting state, and may leave them
//! anywhere: the bench brings them back.

mod fastscan;
mod hands;
mod identity;
mod node;
mod rates;
mod registers;
mod search;
mod services;
mod switch;
mod timing;

use crate::{session::Bench, stop::Stop};

type Session = fn(&mut Bench) -> Result<(), Stop>;

/// The sessions by name.
const ALL: [(&str, Session); 13] = [
    ("registers", registers::run),
    ("LSS services", services::run),
    ("answer times", timing::answers),
    ("back-to-back requests", timing::back_to_back),
    ("SDO", node::sdo),
    ("NMT and heartbeat", node::nmt),
    ("Fastscan", fastscan::run),
    ("bit rates by activation", rates::by_activation),
    ("switch timing", switch::run),
    ("bit rates by store and reset", rates::by_store),
    ("detection of the bit rate", search::detection),
    ("rescue", search::rescue),
    ("power cut and short circuit", hands::run),
];

/// Runs all sessions.
pub fn run(bench: &mut Bench) -> Result<(), Stop> {
    bench.report.begin("identity");
    identity::find(bench)?;
    bench.prepare()?;
    identity::check(bench)?;
    for (name, session) in ALL {
        bench.report.begin(name);
        session(bench)?;
        bench.settle()?;
    }
    Ok(())
}
