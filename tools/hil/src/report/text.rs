//! The report as text, for a terminal and a file.

use super::{Check, Left, Outcome, Report};

/// One line for a check.
pub fn line(check: &Check) -> String {
    let expected = check.expected.as_ref().filter(|_| check.outcome == Outcome::Failed);
    let expected = expected.map(|expected| format!(", expected {expected}")).unwrap_or_default();
    format!("  {}  {}: {}{expected}", outcome(check), check.what, check.seen)
}

/// The same with what was expected in any case, and the rule.
fn row(check: &Check) -> String {
    let expected = check.expected.as_ref().filter(|_| check.outcome == Outcome::Passed);
    let expected = expected.map(|expected| format!(", expected {expected}")).unwrap_or_default();
    format!("{}{expected} [{}]", line(check), check.rule)
}

pub fn outcome(check: &Check) -> &'static str {
    match check.outcome {
        Outcome::Passed => "passed",
        Outcome::Failed => "FAILED",
        Outcome::NotTried => "not tried",
    }
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
    let head = report.head.lines().map(|(name, value)| format!("{name}: {value}\n"));
    let mut text = "cargo hil\n".to_owned() + &head.concat();
    for line in report.bench.iter().chain(&report.boards) {
        text += &format!("{line}\n");
    }
    for checks in report.checks.chunk_by(|a, b| a.session == b.session) {
        text += &format!("\n{}\n", checks[0].session);
        for check in checks {
            text += &format!("{}\n", row(check));
        }
    }
    text + &summary(report)
}
