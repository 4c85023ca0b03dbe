//! The report as JSON, for programs.

use serde_json::json;

use super::{Left, Report};

pub fn whole(report: &Report) -> String {
    let value = json!({
        "head": report.head,
        "bench": report.bench,
        "boards": report.boards,
        "good": report.is_good(),
        "seconds": report.begin.elapsed().as_secs_f64(),
        "stopped": report.stopped,
        "left": match &report.left {
            Left::Untouched => "untouched".to_owned(),
            Left::Restored => "restored".to_owned(),
            Left::Changed(words) => format!("changed: {words}"),
        },
        "checks": report.checks,
        "answers": report.answers,
        "switches": report.switches,
    });
    format!("{value:#}\n")
}
