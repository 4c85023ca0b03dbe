//! `cargo verify coverage`: the branches of the release image that its tests have taken.

mod report;

use std::{env, fs, io, path::Path, process::Command};

use anyhow::{Context, ensure};
use emulator::coverage::Record;
use testkit::{
    cargo::{cargo, workspace},
    image::COVERAGE,
};
use xtask::tool;

use report::Report;

/// The records that count, each named by the package and the chip of its image, and the least share of outcomes in
/// percent: the firmware as it is, and the example. A share may rise, and falls only by a change that says why. Much of
/// the rest cannot happen, such as overflows of saturating sums.
const IMAGES: [(&str, usize); 2] = [("firmware-stm32f405", 80), ("example-io-stm32f407", 82)];
/// The seed of the random tests, so that a branch is not taken by chance.
const SEED: &str = "7";

/// Count the branches of the release image that its tests take
///
/// Runs `cargo test --test image`, the part of it that `cargo test --test image_io` runs with the example `io`, and the
/// cases of `cargo verify conformance`. The emulator notes the outcome of each conditional branch, each condition of an IT block, each table branch and each
/// computed jump on every board with the firmware for the STM32F405, or with the example `io` for the STM32F407. A copy
/// that the compiler has inlined counts as a branch of its own; dependencies and start-up code do not count. Fails if
/// the share of outcomes that were taken is below the one that verify/src/coverage.rs states.
///
/// target/coverage/lcov.info has the lines and branches for other programs, such as genhtml.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// Only the tests with one of these in their path
    filter: Vec<String>,
    /// Add to what the last runs have taken
    #[arg(long)]
    keep: bool,
    /// Run no tests: report what the last runs have taken
    #[arg(long, conflicts_with = "filter")]
    report: bool,
    /// Print each outcome that is missing
    #[arg(long)]
    missing: bool,
}

/// Runs the tests and prints the numbers of outcomes. Fails if they are too few.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let directory = workspace().join("target/coverage");
    if !arguments.report {
        if !arguments.keep {
            remove(&directory)?;
        }
        fs::create_dir_all(&directory)?;
        test(&directory, &arguments.filter)?;
    }
    let mut report = Report::default();
    for (image, _) in IMAGES {
        let path = directory.join(image).with_extension("branches");
        if path.exists() {
            let record = Record::read(&path).with_context(|| path.display().to_string())?;
            report.add(image, &path.with_extension("elf"), &record)?;
        }
    }
    fs::write(directory.join("lcov.info"), report.lcov()).context("lcov.info")?;
    if arguments.missing {
        for (place, line) in &report.lines {
            for branch in line.branches.iter().filter(|branch| branch.is_incomplete()) {
                println!("{}:{} {}: {branch}", place.file, place.line, place.function);
            }
        }
    }
    println!("\n{:28} {:>8} {:>8} {:>8}", "outcomes of our branches", "total", "taken", "least");
    let mut is_enough = true;
    for (image, least) in IMAGES {
        let (total, taken) = report.count(image);
        println!("{image:28} {total:>8} {taken:>8} {:>8}", total * least / 100);
        is_enough &= total > 0 && taken >= total * least / 100;
    }
    ensure!(
        is_enough || !arguments.filter.is_empty(),
        "the tests take less: `cargo verify coverage --report --missing` lists what is missing"
    );
    Ok(())
}

fn remove(directory: &Path) -> io::Result<()> {
    match fs::remove_dir_all(directory) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        outcome => outcome,
    }
}

/// Runs the tests of the image, and unless there is a filter the cases of conformance, with a record of the branches.
fn test(directory: &Path, filter: &[String]) -> anyhow::Result<()> {
    let mut cargo = cargo();
    cargo.args(["test", "--test", "image", "--test", "image_io", "--"]).args(filter);
    tool::run(cargo.env(COVERAGE, directory).env("SEED", SEED), "the tests of the image fail")?;
    if !filter.is_empty() {
        return Ok(());
    }
    for chapter in ["cia301", "lss"] {
        let mut cases = Command::new(env::current_exe()?);
        cases.args(["conformance", "--chapter", chapter]).env(COVERAGE, directory);
        tool::run(&mut cases, "a case of conformance fails")?;
    }
    Ok(())
}
