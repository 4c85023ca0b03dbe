//! `cargo xtask coverage`: the branches of the release image that its tests have taken.

mod branch;
mod explanations;
mod lcov;
mod page;
mod program;
mod report;

use std::{env, fs, io, path::Path, process::Command};

use anyhow::{Context, ensure};
use emulator::coverage::Record;
use testkit::image::{COVERAGE, EXAMPLE};

use explanations::Explanations;
use program::Program;
use report::{Count, Report};

/// The records that count, each with the features of its image: the firmware as it is, and the example.
const IMAGES: [&str; 2] = ["stm32f405", "stm32f407-io"];
/// The beginnings of their rows in the table of the page.
const ROWS: [&str; IMAGES.len()] = ["| STM32F405 | ", "| STM32F407 with `io` | "];
/// The page with the reasons.
const PAGE: &str = "docs/coverage.md";
/// The tests that run a second time, with the example in the image: those of what the example has in common with the
/// firmware as it is, but times and sizes.
const TESTS_WITH_EXAMPLE: [&str; 17] = [
    "bit_rate::",
    "can_traps::",
    "chip_traps::",
    "commissioning::",
    "errors::",
    "medium_faults::",
    "node_id::",
    "overload::",
    "power_cut::",
    "rare_moments::",
    "rare_paths::",
    "rates_bus_off::",
    "rates_detection::",
    "rates_rescue::",
    "robustness::",
    "session::",
    "uptime::",
];
/// One of them whose expectations are those of a smaller SDO server.
const NOT_WITH_EXAMPLE: &str = "each_wrong_sdo_request_has_its_abort_code";
/// The seed of the random tests, so that a branch is not taken by chance.
const SEED: &str = "7";

/// Show the branches of the release image that its tests take in one direction only, or never
///
/// Runs `cargo test --test image`, and then a part of it again with the example `io` in the image. The emulator notes
/// the outcome of each conditional branch, each condition of an IT block, each table branch and each computed jump on
/// every board with the firmware for the STM32F405, or with the example `io` for the STM32F407. A copy that the
/// compiler has inlined counts as a branch of its own. An outcome of our code that is missing needs a reason in
/// docs/coverage.md, and a reason there has the number of outcomes that it explains: otherwise the command fails.
/// Dependencies and start-up code are listed apart.
///
/// target/coverage/index.html has the sources with the branches marked, target/coverage/lcov.info the same for other
/// programs.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// Only the tests with one of these in their path, once
    filter: Vec<String>,
    /// Add to what the last runs have taken
    #[arg(long)]
    keep: bool,
    /// Run no tests: report what the last runs have taken
    #[arg(long, conflicts_with = "filter")]
    report: bool,
    /// Write to docs/coverage.md how many outcomes there are, and how many each reason explains: read the list first
    #[arg(long)]
    write_counts: bool,
    /// Print also what is explained, and the dependencies
    #[arg(long)]
    all: bool,
}

/// Runs the tests and prints what is missing. Fails if some of it is not explained.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let workspace =
        Path::new(env!("CARGO_MANIFEST_DIR")).parent().context("xtask is in a workspace")?;
    let directory = workspace.join("target/coverage");
    if !arguments.report {
        if !arguments.keep {
            remove(&directory)?;
        }
        fs::create_dir_all(&directory)?;
        test(workspace, &directory, &arguments.filter, false)?;
        if arguments.filter.is_empty() {
            let filter = TESTS_WITH_EXAMPLE.map(str::to_owned);
            test(workspace, &directory, &filter, true)?;
        }
    }
    let path = workspace.join(PAGE);
    let page = fs::read_to_string(&path).context(PAGE)?;
    let explanations = Explanations::parse(&page).context(PAGE)?;
    let mut report = Report::default();
    let mut images = Vec::new();
    for image in IMAGES {
        let path = directory.join(image).with_extension("branches");
        if path.exists() {
            let record = Record::read(&path).with_context(|| path.display().to_string())?;
            report.add(image, &Program::load(&path.with_extension("elf"), workspace)?, &record);
            images.push(image);
        }
    }
    ensure!(!images.is_empty(), "no coverage was recorded yet: run `cargo xtask coverage` first");
    report.explain(workspace, &explanations)?;
    write(&directory.join("lcov.info"), lcov::lcov(&report)?)?;
    write(&directory.join("index.html"), page::page(&report, &images)?)?;
    print(&report, &images, arguments.all);
    if arguments.write_counts {
        ensure!(images == IMAGES, "the last run was not of both images");
        let page = with_totals(&explanations.with_counts(&page), &report);
        return write(&path, page);
    }
    ensure!(
        report.count(None, None).unexplained == 0,
        "outcomes without a test or a reason in {PAGE}; see target/coverage/index.html"
    );
    let unused = explanations.unused().map(ToString::to_string).collect::<Vec<_>>();
    ensure!(unused.is_empty(), "{PAGE} explains what is not missing:\n  {}", unused.join("\n  "));
    let differences = explanations.differences(&images);
    ensure!(
        differences.is_empty(),
        "{PAGE} has other numbers of outcomes:\n  {}\nIf the reasons hold for all that `cargo xtask coverage --report \
         --all` lists there, `cargo xtask coverage --report --write-counts` writes the numbers.",
        differences.join("\n  ")
    );
    Ok(())
}

fn write(path: &Path, content: String) -> anyhow::Result<()> {
    fs::write(path, content).with_context(|| format!("cannot write {}", path.display()))
}

/// The page with the numbers of all outcomes in its table.
fn with_totals(page: &str, report: &Report) -> String {
    let lines = page.lines().map(|line| {
        let row = IMAGES.into_iter().zip(ROWS).find(|(_, row)| line.starts_with(row));
        row.map_or_else(
            || line.to_owned(),
            |(image, row)| {
                let count = report.count(None, Some(image));
                let Count { seen, explained, open, .. } = count;
                let numbers = [count.total(), seen, explained, open].map(grouped);
                format!("{row}{} |", numbers.join(" | "))
            },
        )
    });
    lines.collect::<Vec<_>>().join("\n") + "\n"
}

/// A number with commas between its thousands.
fn grouped(number: usize) -> String {
    match (number / 1000, number % 1000) {
        (0, rest) => rest.to_string(),
        (thousands, rest) => format!("{},{rest:03}", grouped(thousands)),
    }
}

fn remove(directory: &Path) -> io::Result<()> {
    match fs::remove_dir_all(directory) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        outcome => outcome,
    }
}

/// Runs the tests of the image with a record of the branches.
fn test(
    workspace: &Path,
    directory: &Path,
    filter: &[String],
    with_example: bool,
) -> anyhow::Result<()> {
    let cargo = env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = Command::new(cargo);
    command
        .current_dir(workspace)
        .args(["test", "--test", "image", "--"])
        .args(filter)
        .env(COVERAGE, directory)
        .env("SEED", SEED);
    if with_example {
        command.args(["--skip", NOT_WITH_EXAMPLE]).env(EXAMPLE, "io");
    }
    let status = command.status().context("cannot run cargo")?;
    ensure!(status.success(), "the tests of the image fail");
    Ok(())
}

fn print(report: &Report, images: &[&str], all: bool) {
    let mut last = None;
    let lines = report.ours().filter(|(_, line)| line.missing().next().is_some());
    for (place, line) in lines.filter(|(_, line)| all || line.is_unexplained()) {
        if last != Some((&place.file, &place.function)) {
            println!("\n{}", place.function);
            last = Some((&place.file, &place.function));
        }
        println!("  {}:{}: {}", place.file, place.line, report.text(place));
        for branch in line.missing() {
            println!("    {branch}");
        }
        for explanation in line.explanations() {
            println!("    {}", explanation.reason);
        }
    }
    if all {
        println!("\n{:28} {:>8} {:>8}", "dependencies, outcomes", "total", "taken");
        for (name, count) in report.dependencies() {
            println!("{name:28} {:>8} {:>8}", count.total(), count.seen);
        }
    }
    println!(
        "\n{:28} {:>8} {:>8} {:>10} {:>6} {:>13}",
        "outcomes of our branches", "total", "taken", "cannot be", "open", "not explained"
    );
    for image in images {
        let Count { seen, explained, open, unexplained } = report.count(None, Some(image));
        let total = report.count(None, Some(image)).total();
        println!("{image:28} {total:>8} {seen:>8} {explained:>10} {open:>6} {unexplained:>13}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_has_each_number() {
        let page = include_str!("../../docs/coverage.md");
        let explanations = Explanations::parse(page).expect("explanations");
        assert!(explanations.have_counts(), "an explanation without numbers");
        let totals = with_totals(page, &Report::default());
        assert_eq!(
            totals.matches(" | 0 | 0 | 0 | 0 |\n").count(),
            IMAGES.len(),
            "a row for each image"
        );
    }

    #[test]
    fn thousands_are_grouped() {
        for (number, text) in [(0, "0"), (999, "999"), (1_000, "1,000"), (1_234_056, "1,234,056")] {
            assert_eq!(grouped(number), text);
        }
    }
}
