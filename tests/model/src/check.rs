//! A run of the checker, and its report.

use std::fmt::Write;

use stateright::{Checker, HasDiscoveries, Model};

use crate::Scenario;

/// What the checker has found.
pub struct Report {
    /// The number of different states that were reached.
    pub different: usize,
    /// All states of the scenario were reached.
    pub is_complete: bool,
    /// The properties that do not hold.
    pub violations: Vec<&'static str>,
    /// All of this, and a shortest run that violates each of them.
    pub text: String,
}

/// Checks a scenario breadth first, until this number of states is reached, with repetitions.
pub fn check(scenario: Scenario, states: usize) -> Report {
    let checker = scenario.checker().target_state_count(states);
    let checker = checker.finish_when(HasDiscoveries::AnyFailures).spawn_bfs().join();
    let runs = checker.discoveries();
    let (all, different) = (checker.state_count(), checker.unique_state_count());
    let is_complete = all < states && runs.is_empty();
    let extent = if is_complete { "all of them" } else { "not all" };
    let depth = checker.max_depth();
    let mut text = format!(
        "{different} states ({extent}), {all} with repetitions, runs of up to {depth} events"
    );
    let violations = runs.keys().copied().collect();
    for (property, run) in runs {
        write!(text, "\nVIOLATED: {property}").expect("a string takes all");
        for event in run.into_actions() {
            write!(text, "\n    {event:?}").expect("a string takes all");
        }
    }
    Report { different, is_complete, violations, text }
}
