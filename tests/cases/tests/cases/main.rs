//! The cases on nodes in the process: all hold, and on devices and lines that break one rule at a time those that prove it
//! fail.

mod application_layer;
mod guarded;
mod lss;

use std::collections::BTreeSet;

use conformance::{APPLICATION_LAYER, Group, OWN, Outcome, UNPREPARED, lss::LSS};

/// Whether a case has failed, and not only what precedes it.
fn has_failed(outcome: &Outcome) -> bool {
    matches!(outcome, Outcome::Failed(expected) if !expected.starts_with(UNPREPARED))
}

/// The numbers of cases: `SDO 3 5, PDO 23`.
fn numbers(cases: &'static str) -> impl Iterator<Item = String> {
    cases.split(", ").filter(|group| !group.is_empty()).flat_map(|group| {
        let places = group.find(|c: char| c.is_ascii_digit()).unwrap_or(group.len());
        let (name, places) = group.split_at(places);
        let number = move |place| format!("{} {place:0>2}", name.trim());
        if places.is_empty() {
            vec![name.to_owned()]
        } else {
            places.split(' ').map(number).collect()
        }
    })
}

#[test]
fn every_case_was_seen_to_fail() {
    let seen: BTreeSet<String> = application_layer::seen_to_fail()
        .chain(guarded::seen_to_fail())
        .chain(lss::seen_to_fail())
        .collect();
    let groups: Vec<Group> = [APPLICATION_LAYER, OWN, LSS].concat();
    let all =
        groups.iter().flat_map(|group| (0..group.cases.len()).map(|place| group.number(place)));
    let missing: Vec<String> = all.filter(|number| !seen.contains(number)).collect();
    assert_eq!(missing, lss::WITHOUT_RESCUE);
}
