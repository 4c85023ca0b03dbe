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
    Session {
        name: "services",
        title: "LSS services",
        rule: "CiA 305, configure node-ID",
        run: services::run,
    },
    Session {
        name: "answers",
        title: "answer times",
        rule: "CiA 305, inquire node-ID",
        run: timing::answers,
    },
    Session {
        name: "bursts",
        title: "requests without a pause",
        rule: "CiA 305, inquire identity",
        run: timing::bursts,
    },
    Session { name: "sdo", title: "SDO", rule: "CiA 301, 7.2.4", run: node::sdo },
    Session { name: "nmt", title: "NMT and heartbeat", rule: "CiA 301, 7.3.2", run: node::nmt },
    Session { name: "fastscan", title: "Fastscan", rule: "CiA 305, Fastscan", run: fastscan::run },
    Session {
        name: "activate",
        title: "bit rates by activation",
        rule: "CiA 305, activate bit timing parameters",
        run: rates::by_activation,
    },
    Session {
        name: "switch",
        title: "timing of a switch",
        rule: "CiA 305, activate bit timing parameters",
        run: switch::run,
    },
    Session {
        name: "store",
        title: "bit rates by store and reset",
        rule: "CiA 305, store configuration",
        run: rates::by_store,
    },
    Session {
        name: "detect",
        title: "detection of the bit rate",
        rule: "CiA 305, configure bit timing parameters",
        run: search::detection,
    },
    Session {
        name: "rescue",
        title: "rescue",
        rule: "docs/reference.md, supervision",
        run: search::rescue,
    },
    Session {
        name: "hands",
        title: "power cut and short circuit",
        rule: "CiA 305, store configuration",
        run: hands::run,
    },
];

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
