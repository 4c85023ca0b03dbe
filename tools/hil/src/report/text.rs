//! The report as text, for a terminal and a file.

use super::{Check, Left, Outcome, Report};

/// One line for a check.
pub fn line(check: &Check) -> String {
    format!("  {}  {}: {}", outcome(check), check.what, seen(check))
}

pub fn outcome(check: &Check) -> &'static str {
    match check.outcome {
        Outcome::Passed => "passed",
        Outcome::Failed => "FAILED",
        Outcome::NotTried => "not tried",
    }
}

/// What was seen, and what was expected instead.
pub fn seen(check: &Check) -> String {
    let expected = check.expected.as_ref().map(|expected| format!(", expected {expected}"));
    check.seen.clone() + &expected.unwrap_or_default()
}

/// The result, what differs, and what was not tried.
pub fn summary(report: &Report) -> String {
    let mut text = String::new();
    for (heading, outcome) in
        [("Not tried", Outcome::NotTried), ("Different from the emulated board", Outcome::Failed)]
    {
        let mut checks = report.with_outcome(outcome).peekable();
        if checks.peek().is_some() {
            text += &format!("\n{heading}:\n");
        }
        for check in checks {
            text += &format!("{}  ({})\n", line(check), check.session);
        }
    }
    if let Some(reason) = &report.stopped {
        text += &format!("\nEnded early: {reason}\n");
    }
    text += &match &report.left {
        Left::Untouched => "\nNothing was changed on any board.\n".to_owned(),
        Left::Restored => "\nThe boards are as they were found.\n".to_owned(),
        Left::Changed(words) => format!("\nNOT RESTORED: {words}\n"),
    };
    let count = |outcome| report.with_outcome(outcome).count();
    text + &format!(
        "{}: {} passed, {} failed, {} not tried, in {} s.\n",
        if report.is_good() { "Good" } else { "Not good" },
        count(Outcome::Passed),
        count(Outcome::Failed),
        count(Outcome::NotTried),
        report.begin.elapsed().as_secs()
    )
}

/// The whole report.
pub fn whole(report: &Report) -> String {
    let mut text =
        format!("cargo hil {}\nadapter: {}\n", env!("CARGO_PKG_VERSION"), report.adapter);
    for line in report.bench.iter().chain(&report.boards) {
        text += &format!("{line}\n");
    }
    for checks in report.checks.chunk_by(|a, b| a.session == b.session) {
        text += &format!("\n{}\n", checks[0].session);
        for check in checks {
            text += &format!("{}\n", line(check));
        }
    }
    text + &summary(report)
}
