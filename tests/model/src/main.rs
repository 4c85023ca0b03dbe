//! `cargo model`: checks the network with two and three boards, and prints the number of states.

use std::process::ExitCode;

use network_model::{Scenario, check::check};

/// The states to generate in each scenario, unless it is complete before.
const STATES: usize = 3_000_000;

fn main() -> ExitCode {
    let mut violations = 0;
    for (name, scenario) in Scenario::all() {
        let report = check(scenario, STATES);
        println!("{name}: {report}");
        violations += report.violations.len();
    }
    if violations == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
