//! The report of a run: what was seen, what differs from the expectation, and what was not tried.

mod head;
mod html;
mod json;
mod text;

use std::{
    fs,
    io::{self, IsTerminal},
    path::{Path, PathBuf},
    time::Instant,
};

use can_bus::explain::wrapped;
use serde::Serialize;

pub use head::Head;

/// The outcome of a check.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub enum Outcome {
    #[serde(rename = "passed")]
    Passed,
    #[serde(rename = "failed")]
    Failed,
    #[serde(rename = "not tried")]
    NotTried,
}

/// One thing that was looked at.
#[derive(Clone, Debug, Serialize)]
pub struct Check {
    pub session: &'static str,
    pub what: String,
    pub outcome: Outcome,
    /// What was seen, or why it was not tried.
    pub seen: String,
    /// What was expected; `None` if it was not tried.
    pub expected: Option<String>,
    /// The service of CiA 305, the section of CiA 301, or the page that demands it.
    pub rule: &'static str,
}

/// The time from a request to its answer, at the computer.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Answer {
    pub kbit_per_s: u16,
    pub us: u64,
}

/// A switch of the bit rate, with the times since the request to activate it.
#[derive(Clone, Debug, Serialize)]
pub struct Switch {
    pub from_kbit_per_s: u16,
    pub to_kbit_per_s: u16,
    pub delay_ms: u16,
    /// The last frame before the silence, at or before the request.
    pub last_frame_ms: f64,
    /// The first frame after it; `None`: there was none.
    pub first_frame_ms: Option<f64>,
    /// Frames of the master that were acknowledged or not.
    pub acknowledged: Vec<(f64, bool)>,
}

/// The settings that the boards were left with.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Left {
    /// Nothing was changed.
    Untouched,
    /// As they were found.
    Restored,
    /// A board could not be restored.
    Changed(String),
}

/// The column of the text in a line.
pub const INDENT: usize = 10;

/// Prints lines, of which those that are too long for a terminal are wrapped there to a column.
pub fn show(text: &str, column: usize) {
    for line in text.lines() {
        match io::stdout().is_terminal() {
            true => println!("{}", wrapped(line, column)),
            false => println!("{line}"),
        }
    }
}

pub struct Report {
    pub head: Head,
    pub bench: Vec<String>,
    pub boards: Vec<String>,
    pub checks: Vec<Check>,
    pub answers: Vec<Answer>,
    pub switches: Vec<Switch>,
    /// The reason why the run ended early.
    pub stopped: Option<String>,
    pub left: Left,
    begin: Instant,
    session: &'static str,
    /// The rule of the session, and that of the next check, if it has its own.
    rule: (&'static str, Option<&'static str>),
}

impl Report {
    pub fn new(head: Head) -> Self {
        Self {
            head,
            bench: Vec::new(),
            boards: Vec::new(),
            checks: Vec::new(),
            answers: Vec::new(),
            switches: Vec::new(),
            stopped: None,
            left: Left::Untouched,
            begin: Instant::now(),
            session: "bench",
            rule: ("", None),
        }
    }

    /// Shows what is going on.
    pub fn progress(&self, what: &str) {
        show(&format!("  ...     {what}"), INDENT);
    }

    /// Adds a sentence about the bench.
    pub fn bench(&mut self, sentence: &str) {
        show(&format!("          {sentence}"), INDENT);
        self.bench.push(sentence.to_owned());
    }

    /// Adds a line about a board.
    pub fn board(&mut self, line: String) {
        show(&format!("          {line}"), INDENT);
        self.boards.push(line);
    }

    /// Begins a session: the checks that follow belong to it, and to its rule.
    pub fn begin(&mut self, session: &'static str, rule: &'static str) {
        println!("{session} ({} s)", self.begin.elapsed().as_secs());
        self.session = session;
        self.rule = (rule, None);
    }

    /// Gives the next check a rule of its own.
    pub fn under(&mut self, rule: &'static str) -> &mut Self {
        self.rule.1 = Some(rule);
        self
    }

    pub fn failed(
        &mut self,
        what: impl Into<String>,
        seen: impl Into<String>,
        expected: impl Into<String>,
    ) {
        self.add(what.into(), Outcome::Failed, seen.into(), Some(expected.into()));
    }

    pub fn not_tried(&mut self, what: impl Into<String>, why: impl Into<String>) {
        self.add(what.into(), Outcome::NotTried, why.into(), None);
    }

    /// Adds a check that passes if `is_good`.
    pub fn expect(
        &mut self,
        what: impl Into<String>,
        is_good: bool,
        seen: impl Into<String>,
        expected: impl Into<String>,
    ) {
        let outcome = if is_good { Outcome::Passed } else { Outcome::Failed };
        self.add(what.into(), outcome, seen.into(), Some(expected.into()));
    }

    /// Adds a check that passes if the text seen is the expected one.
    pub fn equal(&mut self, what: impl Into<String>, seen: impl Into<String>, expected: &str) {
        let seen = seen.into();
        self.expect(what, seen == expected, seen, expected);
    }

    /// Adds a check that passes if `is_good`, with the words for both cases.
    pub fn either(&mut self, what: impl Into<String>, is_good: bool, [good, bad]: [&str; 2]) {
        self.equal(what, if is_good { good } else { bad }, good);
    }

    fn add(&mut self, what: String, outcome: Outcome, seen: String, expected: Option<String>) {
        let rule = self.rule.1.take().unwrap_or(self.rule.0);
        let check = Check { session: self.session, what, outcome, seen, expected, rule };
        show(&text::line(&check), INDENT);
        self.checks.push(check);
    }

    pub fn with_outcome(&self, outcome: Outcome) -> impl Iterator<Item = &Check> {
        self.checks.iter().filter(move |check| check.outcome == outcome)
    }

    pub fn is_good(&self) -> bool {
        self.stopped.is_none()
            && self.with_outcome(Outcome::Failed).next().is_none()
            && !matches!(self.left, Left::Changed(_))
    }

    /// The last lines: the result, what differs, what was not tried.
    pub fn summary(&self) -> String {
        text::summary(self)
    }

    /// Writes FILE.txt, FILE.json and FILE.html; an ending of `path` is replaced.
    pub fn write(&self, path: &Path) -> io::Result<[PathBuf; 3]> {
        let files = ["txt", "json", "html"].map(|ending| path.with_extension(ending));
        let [text, json, html] = &files;
        fs::write(text, text::whole(self))?;
        fs::write(json, json::whole(self))?;
        fs::write(html, html::whole(self))?;
        Ok(files)
    }
}
