//! The report as one HTML page.

use ::conformance::{head_table, page};
use can_bus::svg::escape;

use super::{Outcome, Report, text};

pub fn whole(report: &Report) -> String {
    let mut rows = String::new();
    for check in &report.checks {
        let class = match check.outcome {
            Outcome::Passed => "",
            Outcome::Failed => "failed",
            Outcome::NotTried => "skipped",
        };
        let outcome = text::outcome(check);
        let expected = check.expected.as_deref().unwrap_or_default();
        let cells = [check.session, &check.what, outcome, expected, &check.seen, check.rule];
        let cells = cells.map(|cell| format!("<td>{}</td>", escape(cell)));
        rows += &format!("<tr class=\"{class}\">{}</tr>\n", cells.concat());
    }
    let lines = report.bench.iter().chain(&report.boards);
    let bench: String = lines.map(|line| format!("<li>{}</li>\n", escape(line))).collect();
    page(
        "cargo hil",
        &format!(
            "{}<ul>\n{bench}</ul>\n<pre>{}</pre>\n<h2>All checks</h2>\n<table>\
             <tr><th>session<th>check<th>outcome<th>expected<th>seen<th>rule</tr>\n{rows}</table>\n",
            head_table(report.head.lines()),
            escape(text::summary(report).trim())
        ),
    )
}
