//! The report as JSON, for programs.

use serde_json::{Value, json};

use super::{Check, Left, Outcome, Report, Switch};

pub fn whole(report: &Report) -> String {
    let value = json!({
        "version": env!("CARGO_PKG_VERSION"),
        "adapter": report.adapter,
        "bench": report.bench,
        "boards": report.boards,
        "good": report.is_good(),
        "seconds": report.took.as_secs_f64(),
        "stopped": report.stopped,
        "left": match &report.left {
            Left::Untouched => "untouched".to_owned(),
            Left::Restored => "restored".to_owned(),
            Left::Changed(words) => format!("changed: {words}"),
        },
        "checks": report.checks.iter().map(check).collect::<Vec<_>>(),
        "answers": report.answers.iter().map(|answer| json!({
            "kbit_per_s": answer.rate.kbit_per_s(),
            "us": answer.time.as_micros() as u64,
        })).collect::<Vec<_>>(),
        "switches": report.switches.iter().map(switch).collect::<Vec<_>>(),
    });
    format!("{value:#}\n")
}

fn check(check: &Check) -> Value {
    let (outcome, expected) = match &check.outcome {
        Outcome::Passed => ("passed", None),
        Outcome::Failed { expected } => ("failed", Some(expected)),
        Outcome::NotTried => ("not tried", None),
    };
    json!({
        "session": check.session,
        "what": check.what,
        "outcome": outcome,
        "seen": check.seen,
        "expected": expected,
    })
}

fn switch(switch: &Switch) -> Value {
    json!({
        "from_kbit_per_s": switch.from.kbit_per_s(),
        "to_kbit_per_s": switch.to.kbit_per_s(),
        "delay_ms": switch.delay_ms,
        "last_frame_ms": switch.last_frame,
        "first_frame_ms": switch.first_frame,
        "acknowledged": switch.acknowledged,
    })
}
