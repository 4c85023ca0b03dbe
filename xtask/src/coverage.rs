//! `cargo xtask coverage`: the branches of the release image that its tests have taken.

mod branch;
mod lcov;
mod program;
mod report;

use std::{fs, io, path::Path};

use anyhow::{Context, ensure};
use emulator::coverage::Record;
use testkit::{
    cargo::{cargo, workspace},
    image::{COVERAGE, EXAMPLE},
};

use program::Program;
use report::Report;

/// The records that count, each with the features of its image and the least share of outcomes in percent: the firmware
/// as it is, and the example. A share may rise, and falls only by a change that says why.
const IMAGES: [(&str, usize); 2] = [("stm32f405", 92), ("stm32f407-io", 88)];
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

/// Count the branches of the release image that its tests take
///
/// Runs `cargo test --test image`, and then a part of it again with the example `io` in the image. The emulator notes
/// the outcome of each conditional branch, each condition of an IT block, each table branch and each computed jump on
/// every board with the firmware for the STM32F405, or with the example `io` for the STM32F407. A copy that the
/// compiler has inlined counts as a branch of its own; dependencies and start-up code do not count. Fails if the share
/// of outcomes that were taken is below the one that xtask/src/coverage.rs states.
///
/// target/coverage/lcov.info has the lines and branches for other programs, such as genhtml.
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
        test(&directory, &arguments.filter, false)?;
        if arguments.filter.is_empty() {
            let filter = TESTS_WITH_EXAMPLE.map(str::to_owned);
            test(&directory, &filter, true)?;
        }
    }
    let mut report = Report::default();
    for (image, _) in IMAGES {
        let path = directory.join(image).with_extension("branches");
        if path.exists() {
            let record = Record::read(&path).with_context(|| path.display().to_string())?;
            report.add(image, Program::load(&path.with_extension("elf"), workspace())?, &record);
        }
    }
    fs::write(directory.join("lcov.info"), lcov::lcov(&report)?).context("lcov.info")?;
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
        "the tests take less: `cargo xtask coverage --report --missing` lists what is missing"
    );
    Ok(())
}

fn remove(directory: &Path) -> io::Result<()> {
    match fs::remove_dir_all(directory) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        outcome => outcome,
    }
}

/// Runs the tests of the image with a record of the branches.
fn test(directory: &Path, filter: &[String], with_example: bool) -> anyhow::Result<()> {
    let mut command = cargo();
    command
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
