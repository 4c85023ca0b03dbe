//! A run of `cargo hil`, and its report.

use std::{
    fs,
    path::Path,
    process::{Command, Output, Stdio},
    time::{Duration, Instant},
};

use serde_json::Value;
use testkit::cargo;

use crate::folder::new_folder;

/// The outcome of a run.
pub struct Run {
    pub output: String,
    pub is_success: bool,
    pub took: Duration,
    /// The report as JSON.
    pub report: Value,
}

/// The command, with a report in `folder`.
pub fn command(folder: &Path, adapter: &str, arguments: &[&str]) -> Command {
    let mut command = cargo::program("hil");
    command.args(["--adapter", adapter, "--report"]).arg(folder.join("report")).args(arguments);
    command.stdin(Stdio::null());
    command
}

/// Runs to the end, with few repetitions.
pub fn run(name: &str, adapter: &str, arguments: &[&str]) -> Run {
    let folder = new_folder(name);
    let begin = Instant::now();
    let output = command(&folder, adapter, arguments).arg("--quick").output().expect("it runs");
    Run::new(&folder, output, begin.elapsed())
}

impl Run {
    pub fn new(folder: &Path, output: Output, took: Duration) -> Self {
        let json = fs::read_to_string(folder.join("report.json")).unwrap_or_default();
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        let run = Self {
            output: text(&output.stdout) + &text(&output.stderr),
            is_success: output.status.success(),
            took,
            report: serde_json::from_str(&json).unwrap_or_default(),
        };
        println!("{}", run.output);
        run
    }

    /// The failed checks, as lines.
    pub fn failures(&self) -> Vec<String> {
        let checks = self.report["checks"].as_array().expect("a report with checks");
        let failed = checks.iter().filter(|check| check["outcome"] == "failed");
        let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
        failed.map(|check| format!("{}: {}", text(&check["what"]), text(&check["seen"]))).collect()
    }

    #[track_caller]
    pub fn assert_good(&self) {
        assert_eq!(self.failures(), Vec::<String>::new());
        assert_eq!(self.report["stopped"], Value::Null);
        assert_eq!(self.report["left"], "restored");
        assert!(self.is_success);
    }

    /// Asserts that the run failed, with these words in a failed check or as the reason of an early end.
    #[track_caller]
    pub fn assert_named(&self, words: &str) {
        assert!(!self.is_success);
        let stopped = self.report["stopped"].as_str().unwrap_or_default();
        let failures = self.failures();
        let is_named =
            stopped.contains(words) || failures.iter().any(|failure| failure.contains(words));
        assert!(is_named, "{words:?} is not in {failures:#?} and {stopped:?}");
    }

    #[track_caller]
    pub fn assert_left(&self, left: &str) {
        let seen = self.report["left"].as_str().unwrap_or_default();
        assert!(seen.starts_with(left), "{seen}");
    }
}
