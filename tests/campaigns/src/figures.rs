//! `cargo verify figures`: docs/size-and-speed.md, the page with all figures, as the commands in it print them.

use std::fs;

use anyhow::{Context, bail, ensure};

use testkit::cargo::{cargo, workspace};
use xtask::tool;

const PAGE: &str = "docs/size-and-speed.md";

/// Write the figures of docs/size-and-speed.md
///
/// Runs each command in the page and writes its output below it. Takes minutes.
#[derive(clap::Args)]
pub struct Arguments {}

/// Replaces the output of each command in the page.
pub fn run() -> anyhow::Result<()> {
    let path = workspace().join(PAGE);
    let page = fs::read_to_string(&path).context(PAGE)?;
    fs::write(path, with_outputs(&page)?)?;
    println!("{PAGE}");
    Ok(())
}

/// The page with the output of each command between the line `$ cargo ...` and the end of its block.
fn with_outputs(page: &str) -> anyhow::Result<String> {
    let mut new = String::new();
    let mut lines = page.lines();
    while let Some(line) = lines.next() {
        new += &format!("{line}\n");
        if let Some(command) = line.strip_prefix("$ ") {
            new += &output(command)?;
            if !lines.any(|line| line == "```") {
                bail!("a block without an end: {command}");
            }
            new += "```\n";
        }
    }
    Ok(new)
}

/// What a command prints, without what only the runner of tests says. Behind ` | grep -E ` stand the words of which each
/// line must have one: `'flash|RAM'`.
fn output(command: &str) -> anyhow::Result<String> {
    println!("{command}");
    let (command, wanted) = command.split_once(" | grep -E ").unwrap_or((command, ""));
    let mut words = command.split_whitespace();
    ensure!(words.next() == Some("cargo"), "not a command of cargo: {command}");
    let output =
        tool::output(cargo().args(words).envs([("RUST_TEST_THREADS", "1"), ("SEED", "1")]))?;
    Ok(with_any_of(&figures(&output), wanted.trim_matches('\'')))
}

fn with_any_of(lines: &str, words: &str) -> String {
    let has_any = |line: &&str| words.split('|').any(|word| line.contains(word));
    lines.lines().filter(has_any).map(|line| format!("{line}\n")).collect()
}

fn figures(output: &str) -> String {
    let is_of_runner = |line: &&str| {
        let starts = ["running ", "test ", "SEED="];
        line.trim_matches(['.', 'i']).is_empty()
            || starts.iter().any(|start| line.starts_with(start))
    };
    let lines = output.lines().map(|line| line.trim_end().trim_start_matches('.'));
    lines.filter(|line| !is_of_runner(line)).map(|line| format!("{line}\n")).collect()
}
