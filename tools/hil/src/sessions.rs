//! The sessions, in their order. Each finds the boards at the base rate in LSS waiting state, and may leave them
//! anywhere: the bench brings them back.

mod fastscan;
mod hands;
mod identity;
mod node;
mod rates;
mod search;
mod services;
mod switch;
mod timing;

use crate::{bench::Bench, stop::Stop};

/// A session.
pub struct Session {
    /// Its name on the command line.
    pub name: &'static str,
    /// Its heading in the report.
    title: &'static str,
    run: fn(&mut Bench) -> Result<(), Stop>,
}

/// All sessions but the first, which finds the boards.
pub const ALL: [Session; 12] = [
    Session { name: "services", title: "LSS services", run: services::run },
    Session { name: "answers", title: "answer times", run: timing::answers },
    Session { name: "bursts", title: "requests without a pause", run: timing::bursts },
    Session { name: "sdo", title: "SDO", run: node::sdo },
    Session { name: "nmt", title: "NMT and heartbeat", run: node::nmt },
    Session { name: "fastscan", title: "Fastscan", run: fastscan::run },
    Session { name: "activate", title: "bit rates by activation", run: rates::by_activation },
    Session { name: "switch", title: "timing of a switch", run: switch::run },
    Session { name: "store", title: "bit rates by store and reset", run: rates::by_store },
    Session { name: "detect", title: "detection of the bit rate", run: search::detection },
    Session { name: "rescue", title: "rescue", run: search::rescue },
    Session { name: "hands", title: "power cut and short circuit", run: hands::run },
];

/// Finds the boards, then runs the sessions with these names; all of them if there is no name.
pub fn run(bench: &mut Bench, names: &[String]) -> Result<(), Stop> {
    bench.report.begin("identity");
    identity::find(bench)?;
    bench.prepare()?;
    identity::check(bench)?;
    let is_wanted =
        |session: &&Session| names.is_empty() || names.iter().any(|name| name == session.name);
    for session in ALL.iter().filter(is_wanted) {
        bench.report.begin(session.title);
        (session.run)(bench)?;
        bench.settle()?;
    }
    Ok(())
}
