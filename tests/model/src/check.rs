//! A run of the checker, and its report.

use std::{fmt, time::Instant};

use stateright::{Checker, HasDiscoveries, Model};

use crate::{Event, Scenario};

/// What the checker has found.
#[derive(Debug)]
pub struct Report {
    /// The states that were reached, and the different ones among them.
    pub generated: usize,
    pub different: usize,
    /// The number of events of the longest run.
    pub depth: usize,
    /// All states of the scenario were reached.
    pub is_complete: bool,
    pub seconds: f64,
    /// The properties that do not hold, each with a shortest run that violates it.
    pub violations: Vec<(&'static str, Vec<Event>)>,
}

/// Checks a scenario breadth first, until this number of states is reached.
pub fn check(scenario: Scenario, states: usize) -> Report {
    let begin = Instant::now();
    let checker = scenario.checker().target_state_count(states);
    let checker = checker.finish_when(HasDiscoveries::AnyFailures).spawn_bfs().join();
    let mut violations: Vec<_> = checker
        .discoveries()
        .into_iter()
        .map(|(property, path)| (property, path.into_actions()))
        .collect();
    violations.sort_by_key(|(property, _)| *property);
    Report {
        generated: checker.state_count(),
        different: checker.unique_state_count(),
        depth: checker.max_depth(),
        is_complete: checker.state_count() < states && violations.is_empty(),
        seconds: begin.elapsed().as_secs_f64(),
        violations,
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { generated, different, depth, seconds, .. } = self;
        let extent = if self.is_complete { "all of them" } else { "not all" };
        write!(f, "{different} states ({extent}), {generated} with repetitions, ")?;
        write!(f, "runs of up to {depth} events, {seconds:.0} s")?;
        for (property, events) in &self.violations {
            write!(f, "\nVIOLATED: {property}")?;
            for event in events {
                write!(f, "\n    {event:?}")?;
            }
        }
        Ok(())
    }
}
