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
    /// What demands it, unless a check names its own rule.
    rule: &'static str,
    run: fn(&mut Bench) -> Result<(), Stop>,
}

/// All sessions but the first, which finds the boards.
pub const ALL: [Session; 12] = [
    session("services", "LSS services", "CiA 305, configure node-ID", services::run),
    session("answers", "answer times", "CiA 305, inquire node-ID", timing::answers),
    session("bursts", "requests without a pause", "CiA 305, inquire identity", timing::bursts),
    session("sdo", "SDO", "CiA 301, 7.2.4", node::sdo),
    session("nmt", "NMT and heartbeat", "CiA 301, 7.3.2", node::nmt),
    session("fastscan", "Fastscan", "CiA 305, Fastscan", fastscan::run),
    session(
        "activate",
        "bit rates by activation",
        "CiA 305, activate bit timing parameters",
        rates::by_activation,
    ),
    session("switch", "timing of a switch", "CiA 305, activate bit timing parameters", switch::run),
    session(
        "store",
        "bit rates by store and reset",
        "CiA 305, store configuration",
        rates::by_store,
    ),
    session(
        "detect",
        "detection of the bit rate",
        "CiA 305, configure bit timing parameters",
        search::detection,
    ),
    session("rescue", "rescue", "docs/reference.md, supervision", search::rescue),
    session("hands", "power cut and short circuit", "CiA 305, store configuration", hands::run),
];

const fn session(
    name: &'static str,
    title: &'static str,
    rule: &'static str,
    run: fn(&mut Bench) -> Result<(), Stop>,
) -> Session {
    Session { name, title, rule, run }
}

/// Finds the boards, then runs the sessions with these names; all of them if there is no name.
pub fn run(bench: &mut Bench, names: &[String]) -> Result<(), Stop> {
    bench.report.begin("identity", "CiA 305, inquire identity");
    identity::find(bench)?;
    bench.prepare()?;
    identity::check(bench)?;
    let is_wanted =
        |session: &&Session| names.is_empty() || names.iter().any(|name| name == session.name);
    for session in ALL.iter().filter(is_wanted) {
        bench.report.begin(session.title, session.rule);
        (session.run)(bench)?;
        bench.settle()?;
    }
    Ok(())
}
