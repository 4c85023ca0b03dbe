//! A share of the states of the network, and the proof that the checker finds a defect of each kind.

use network_model::{
    FOUND, KEPT, ONE_SELECTED, OWN_NODE_ID, Scenario, check::check, mutation::Mutation,
};

/// The states that one test visits at most, with repetitions.
const STATES: usize = 40_000;

fn hold_in(scenario: Scenario) {
    let report = check(scenario, STATES);
    println!("{}", report.text);
    assert!(report.violations.is_empty() && report.different > 5_000);
}

#[test]
fn the_properties_hold_with_one_board() {
    hold_in(Scenario::new(1, 3, 2));
}

#[test]
fn the_properties_hold_with_two_boards() {
    hold_in(Scenario { recover_every: 50, ..Scenario::new(2, 2, 2) });
}

#[test]
fn the_properties_hold_with_two_boards_without_supervision() {
    hold_in(Scenario { is_supervised: false, recover_every: 50, ..Scenario::new(2, 2, 2) });
}

#[test]
fn the_properties_hold_with_three_boards_at_one_bit_rate() {
    hold_in(Scenario { has_switches: false, recover_every: 10, ..Scenario::new(3, 3, 1) });
}

#[test]
fn the_properties_hold_with_node_ids_in_the_order_of_finding() {
    let scenario = Scenario { is_in_order: true, has_switches: false, ..Scenario::new(2, 3, 0) };
    hold_in_all_of(Scenario { recover_every: 50, ..scenario });
}

/// Checks every state.
fn hold_in_all_of(scenario: Scenario) {
    let report = check(scenario, 10 * STATES);
    println!("{}", report.text);
    assert!(report.is_complete);
}

#[test]
fn the_properties_hold_in_all_states_of_two_boards_at_one_bit_rate() {
    hold_in_all_of(Scenario { has_switches: false, recover_every: 50, ..Scenario::new(2, 2, 2) });
}

#[test]
fn the_properties_hold_in_all_states_of_three_boards_at_one_bit_rate() {
    hold_in_all_of(Scenario { has_switches: false, recover_every: 50, ..Scenario::new(3, 2, 1) });
}

/// Checks that the checker finds a violation, and no other first.
fn is_violated(property: &'static str, scenario: Scenario) {
    let report = check(scenario, 20 * STATES);
    println!("{}", report.text);
    assert!(report.violations.contains(&property));
}

fn mutated(mutation: Mutation, boards: usize, recover_every: u64) -> Scenario {
    let has_switches = mutation == Mutation::StaysSilent;
    let mutation = Some(mutation);
    Scenario { mutation, has_switches, recover_every, ..Scenario::new(boards, 2, 0) }
}

#[test]
fn a_memory_that_confirms_one_store_and_keeps_a_failed_one_is_found() {
    let mutation = Some(Mutation::StoresWhatFailed);
    is_violated(KEPT, Scenario { mutation, recover_every: 0, ..Scenario::new(1, 2, 1) });
}

#[test]
fn a_defect_of_each_kind_is_found() {
    for (property, mutation, boards, recover_every) in [
        (KEPT, Mutation::ConfirmsWithoutStoring, 1, 0),
        (FOUND, Mutation::StaysSilent, 1, 1),
        (ONE_SELECTED, Mutation::MatchesEveryScan, 2, 0),
        (ONE_SELECTED, Mutation::MatchesEverySelect, 2, 0),
        (ONE_SELECTED, Mutation::IgnoresWaiting, 2, 0),
        (OWN_NODE_ID, Mutation::TakesEveryNodeId, 2, 0),
    ] {
        println!("{mutation:?}");
        is_violated(property, mutated(mutation, boards, recover_every));
    }
}

#[test]
fn a_node_that_keeps_the_node_id_of_a_session_that_it_leaves_is_found() {
    let scenario = mutated(Mutation::LeavesItsSession, 2, 0);
    is_violated(OWN_NODE_ID, Scenario { is_in_order: true, procedures: 3, ..scenario });
}

#[test]
fn a_request_that_one_board_misses_leaves_two_selected() {
    // A limit of CiA 305: nobody confirms switch state global.
    let scenario = Scenario { has_overruns: true, has_switches: false, ..Scenario::new(2, 2, 2) };
    is_violated(ONE_SELECTED, Scenario { recover_every: 0, ..scenario });
}

#[test]
fn a_master_that_takes_over_within_a_switch_selects_two() {
    // Requests within the silence of a switch are ignored, also the one to leave the configuration state.
    let scenario = Scenario { is_patient: false, recover_every: 0, ..Scenario::new(2, 2, 2) };
    is_violated(ONE_SELECTED, scenario);
}
