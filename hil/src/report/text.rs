//! The report as text, for a terminal and a file.

use super::{Check, Left, Outcome, Report};

/// One line for a check.
pub fn line(check: &Check) -> String {
    let Check { what, seen, .. } = check;
    match &check.outcome {
        Outcome::Passed => format!("  passed  {what}: {seen}"),
        Outcome::Failed { expected } => format!("  FAILED  {what}: {seen}, expected {expected}"),
        Outcome::NotTried => format!("  not tried  {what}: {seen}"),
    }
}

/// The result, what differs, and what was not tried.
pub fn summary(report: &Report) -> String {
    let count = |wanted: fn(&Outcome) -> bool| {
        report.checks.iter().filter(|check| wanted(&check.outcome)).count()
    };
    let passed = count(|outcome| *outcome == Outcome::Passed);
    let not_tried = count(|outcome| *outcome == Outcome::NotTried);
    let failed = report.failures().count();
    let mut text = String::new();
    let mut list = |heading: &str, checks: Vec<&Check>| {
        if !checks.is_empty() {
            text += &format!("\n{heading}:\n");
            for check in checks {
                text += &format!("{}  ({})\n", line(check), check.session);
            }
        }
    };
    list(
        "Not tried",
        report.checks.iter().filter(|check| check.outcome == Outcome::NotTried).collect(),
    );
    list("Different from the emulated board", report.failures().collect());
    if let Some(reason) = &report.stopped {
        text += &format!("\nEnded early: {reason}\n");
    }
    text += &match &report.left {
        Left::Untouched => "\nNothing was changed on any board.\n".to_owned(),
        Left::Restored => "\nThe boards are as they were found.\n".to_owned(),
        Left::Changed(words) => format!("\nNOT RESTORED: {words}\n"),
    };
    let verdict = if report.is_good() { "Good" } else { "Not good" };
    text + &format!(
        "{verdict}: {passed} passed, {failed} failed, {not_tried} not tried, in {} s.\n",
        report.took.as_secs()
    )
}

/// The whole report.
pub fn whole(report: &Report) -> String {
    let mut text =
        format!("cargo hil {}\nadapter: {}\n", env!("CARGO_PKG_VERSION"), report.adapter);
    for line in report.bench.iter().chain(&report.boards) {
        text += &format!("{line}\n");
    }
    let mut session = "";
    for check in &report.checks {
        if check.session != session {
            session = check.session;
            text += &format!("\n{session}\n");
        }
        text += &format!("{}\n", line(check));
    }
    text + &summary(report)
}
