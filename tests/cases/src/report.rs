//! The findings of a run: as text, as one HTML page, and as JUnit XML for other programs.

use std::{fmt::Write as _, time::Duration};

use can_bus::svg::escape;
use canopen_node::Frame;

use crate::{
    Case,
    bench::{Seen, hex},
};

/// How a case ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    Passed,
    /// What was expected.
    Failed(String),
    /// Why the device could not be asked.
    Skipped(String),
}

/// A case that was run.
#[derive(Clone)]
pub struct Finding {
    /// Such as `SDO 01`.
    pub number: String,
    pub group: &'static str,
    pub case: Case,
    pub outcome: Outcome,
    pub frames: Vec<(Duration, Seen)>,
    pub took: Duration,
}

/// All findings about one device.
#[derive(Clone)]
pub struct Report {
    /// What was tested, in one line.
    pub device: String,
    /// What a reader has to know to repeat the run: names and values.
    pub head: Vec<(&'static str, String)>,
    pub findings: Vec<Finding>,
}

/// The lines of a long case that are shown: its first and its last.
const FIRST: usize = 20;
const LAST: usize = 100;

impl Finding {
    /// One line with number, outcome and purpose; a second one with why it was skipped, or two with what was expected
    /// and where the case is not the tool's.
    pub fn line(&self) -> String {
        let Self { number, case: Case { purpose, remark, .. }, .. } = self;
        let line = |word: &str| format!("{number:<28} {word:<8} {purpose}");
        match &self.outcome {
            Outcome::Passed => line("passed"),
            Outcome::Failed(expected) => {
                let failed = format!("{}\n{:37} expected: {expected}", line("FAILED"), "");
                if remark.is_empty() { failed } else { format!("{failed}\n{:37} {remark}", "") }
            }
            Outcome::Skipped(reason) => format!("{}\n{:37} {reason}", line("skipped"), ""),
        }
    }

    /// The frames with their times in milliseconds since the beginning of the case.
    pub fn frames(&self) -> Vec<String> {
        let begin = self.frames.first().map_or(Duration::ZERO, |(time, _)| *time);
        let line = |(time, seen): &(Duration, Seen)| {
            let ms = (*time - begin).as_micros() as f64 / 1e3;
            let what = match seen {
                Seen::Sent(frame) => format!("-> {}", text(frame)),
                Seen::SentOther(text) => format!("-> {text}"),
                Seen::Received(frame) => format!("<- {}", text(frame)),
                Seen::Note(note) => format!("   {note}"),
            };
            format!("{ms:>10.3} {what}")
        };
        let mut lines: Vec<_> = self.frames.iter().map(line).collect();
        let left_out = lines.len().saturating_sub(FIRST + LAST);
        if left_out > 0 {
            lines.splice(FIRST..FIRST + left_out, [format!("           ({left_out} more)")]);
        }
        lines
    }
}

/// COB-ID and bytes.
pub fn text(frame: &Frame) -> String {
    format!("{:03X}  {}", frame.cob_id(), hex(frame.data()))
}

impl Report {
    pub fn new(device: impl Into<String>) -> Self {
        Self { device: device.into(), head: Vec::new(), findings: Vec::new() }
    }

    fn count(&self, is_it: impl Fn(&Outcome) -> bool) -> usize {
        self.findings.iter().filter(|finding| is_it(&finding.outcome)).count()
    }

    pub fn passed(&self) -> usize {
        self.count(|outcome| *outcome == Outcome::Passed)
    }

    pub fn failed(&self) -> usize {
        self.count(|outcome| matches!(outcome, Outcome::Failed(_)))
    }

    pub fn skipped(&self) -> usize {
        self.count(|outcome| matches!(outcome, Outcome::Skipped(_)))
    }

    /// The counts in words.
    fn counts(&self) -> String {
        let (passed, failed, skipped) = (self.passed(), self.failed(), self.skipped());
        let (all, plural) = (self.findings.len(), if self.findings.len() == 1 { "" } else { "s" });
        format!("{all} case{plural}, {passed} passed, {failed} failed, {skipped} skipped")
    }

    /// The device and the counts in one line.
    pub fn summary(&self) -> String {
        format!("{}: {}", self.device, self.counts())
    }
}

const STYLE: &str = "body{font:15px/1.45 system-ui,sans-serif;max-width:70em;margin:2em auto;padding:0 1em;color:#222}\
    table{border-collapse:collapse;width:100%}td,th{padding:.25em .6em;border-bottom:1px solid #ddd;text-align:left;\
    vertical-align:top}.failed{background:#fde8e8}.skipped{color:#777}.remark{color:#555;font-size:.92em}\
    pre{background:#f5f5f5;color:#222;padding:.8em;margin:.4em 0;overflow-x:auto;white-space:pre-wrap}\
    summary{cursor:pointer}";

/// A page of HTML with this title, which is its heading too, and this content.
pub fn page(title: &str, content: &str) -> String {
    format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><meta charset=\"utf-8\"><title>{title}</title>\
         <style>{STYLE}</style>\n<h1>{title}</h1>\n{content}</html>\n"
    )
}

/// A table of what a reader has to know to repeat a run: names and values.
pub fn head_table<'a>(lines: impl IntoIterator<Item = (&'a str, &'a str)>) -> String {
    let rows = lines.into_iter();
    let rows = rows.map(|(name, value)| format!("<tr><th>{name}<td>{}</tr>\n", escape(value)));
    format!("<table>\n{}</table>\n", rows.collect::<String>())
}

/// One page with all findings of these reports; a click on a case shows its frames.
pub fn html(reports: &[Report]) -> String {
    let mut content = String::new();
    for report in reports {
        let head = head_table(report.head.iter().map(|(name, value)| (*name, &**value)));
        content += &format!(
            "<h2>{}</h2>\n{head}<p>{}. A click on a case shows its frames.\n<table>\n\
             <tr><th>case<th>outcome<th>time<th>purpose</tr>\n{}</table>\n",
            escape(&report.device),
            report.counts(),
            report.findings.iter().map(row).collect::<String>()
        );
    }
    page("Conformance", &content)
}

fn row(finding: &Finding) -> String {
    let Finding { number, case, outcome, .. } = finding;
    let (class, word, why) = match outcome {
        Outcome::Passed => ("passed", "passed", String::new()),
        Outcome::Failed(expected) => {
            ("failed", "FAILED", format!("<br>Expected: {}", escape(expected)))
        }
        Outcome::Skipped(reason) => ("skipped", "skipped", format!("<br>{}", escape(reason))),
    };
    let remark = match case.remark {
        "" => String::new(),
        remark => format!("<div class=\"remark\">{}</div>", escape(remark)),
    };
    let frames = escape(&finding.frames().join("\n"));
    let open = if class == "failed" { " open" } else { "" };
    let took = finding.took.as_secs_f64();
    format!(
        "<tr class=\"{class}\"><td>{}<td>{word}<td>{took:.2} s\
         <td><details{open}><summary>{}{why}</summary>{remark}<pre>{frames}</pre></details></tr>\n",
        escape(number),
        escape(case.purpose)
    )
}

/// JUnit XML, with a test suite for each report.
pub fn junit(reports: &[Report]) -> String {
    let mut xml = String::from("<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<testsuites>\n");
    for report in reports {
        let (all, failed, skipped) = (report.findings.len(), report.failed(), report.skipped());
        let name = escape(&report.device);
        let counts = format!("tests=\"{all}\" failures=\"{failed}\" skipped=\"{skipped}\"");
        writeln!(xml, "<testsuite name=\"{name}\" {counts}>").expect("a string takes any text");
        if !report.head.is_empty() {
            let property = |(name, value): &(&str, String)| {
                format!("<property name=\"{name}\" value=\"{}\"/>", escape(value))
            };
            let properties: String = report.head.iter().map(property).collect();
            writeln!(xml, "<properties>{properties}</properties>")
                .expect("a string takes any text");
        }
        for finding in &report.findings {
            xml += &test_case(finding);
        }
        xml += "</testsuite>\n";
    }
    xml + "</testsuites>\n"
}

fn test_case(finding: &Finding) -> String {
    let Finding { number, group, case, took, .. } = finding;
    let content = match &finding.outcome {
        Outcome::Passed => String::new(),
        Outcome::Failed(expected) => {
            let frames = escape(&finding.frames().join("\n"));
            format!("<failure message=\"{}\">{frames}</failure>", escape(expected))
        }
        Outcome::Skipped(reason) => format!("<skipped message=\"{}\"/>", escape(reason)),
    };
    format!(
        "<testcase classname=\"{group}\" name=\"{}\" time=\"{:.3}\">{content}</testcase>\n",
        escape(&format!("{number}: {}", case.purpose)),
        took.as_secs_f64()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_and_a_junit_file_name_what_was_expected_and_escape_it() {
        let frame = Frame::new(0x585, &[0x80, 0, 0x10, 0, 0, 0, 4, 5]).unwrap();
        let finding = |outcome| Finding {
            number: "SDO 07".into(),
            group: "SDO",
            case: Case::new("A & B", |_| Ok(())),
            outcome,
            frames: vec![(Duration::from_millis(7), Seen::Received(frame))],
            took: Duration::from_millis(1),
        };
        let report = Report {
            device: "x".into(),
            head: vec![("date", "1970 & later".into())],
            findings: vec![
                finding(Outcome::Passed),
                finding(Outcome::Failed("a < b".into())),
                finding(Outcome::Skipped("no 1016h".into())),
            ],
        };
        assert_eq!(report.summary(), "x: 3 cases, 1 passed, 1 failed, 1 skipped");
        let mut one = Report::new("x");
        one.findings.push(finding(Outcome::Passed));
        assert_eq!(one.summary(), "x: 1 case, 1 passed, 0 failed, 0 skipped");
        let reports = [report];
        let (page, xml) = (html(&reports), junit(&reports));
        assert!(page.contains("Expected: a &lt; b") && page.contains("A &amp; B"), "{page}");
        assert!(page.contains("0.000 &lt;- 585  80 00 10 00 00 00 04 05"), "{page}");
        assert!(page.contains("<th>date<td>1970 &amp; later"), "{page}");
        assert!(xml.contains("<property name=\"date\" value=\"1970 &amp; later\"/>"), "{xml}");
        assert!(xml.contains("tests=\"3\" failures=\"1\" skipped=\"1\""), "{xml}");
        assert!(xml.contains("<failure message=\"a &lt; b\">"), "{xml}");
        assert!(xml.contains("<skipped message=\"no 1016h\"/>"), "{xml}");
    }
}
