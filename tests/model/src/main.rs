//! `cargo model [STATES]`: checks the network with one to three boards, and prints the number of states.

use std::{env, process::ExitCode};

use network_model::{Scenario, check::check};

/// The states to generate in each scenario, with repetitions, unless it is complete before.
const STATES: usize = 2_000_000;

fn main() -> ExitCode {
    let states = match env::args().nth(1).map(|states| states.parse()) {
        None => STATES,
        Some(Ok(states)) => states,
        Some(Err(error)) => {
            eprintln!("usage: cargo model [STATES]: {error}");
            return ExitCode::FAILURE;
        }
    };
    let mut violations = 0;
    for scenario in Scenario::all() {
        println!("{scenario:?}");
        let report = check(scenario, states);
        println!("{}", report.text);
        violations += report.violations.len();
    }
    if violations == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
