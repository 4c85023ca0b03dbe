//! `cargo verify fuzz`: the coverage-guided fuzz targets, built with the project's compiler, for a limited time.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use anyhow::{Context, bail};
use testkit::cargo::{cargo, workspace};
use xtask::tool;

const TARGETS: [&str; 5] = ["application", "message", "node", "sdo", "settings_log"];

/// The flags of `cargo fuzz` for a nightly compiler, without the address sanitizer: the library has no `unsafe` code.
const RUSTFLAGS: &str = "--cfg fuzzing -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
    -Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table \
    -Cllvm-args=-sanitizer-coverage-trace-compares -Cdebug-assertions -Coverflow-checks -Ccodegen-units=1";

/// Run the library with coverage-guided inputs, and fail if an input breaks a rule
///
/// Needs a C++ compiler, for libFuzzer. The rules are in fuzz/README.md.
#[derive(clap::Args)]
pub struct Arguments {
    /// Targets [default: all, one after the other]
    #[arg(value_parser = TARGETS)]
    target: Vec<String>,
    /// Seconds for each target: 1 to 1,000,000
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    seconds: u32,
}

/// Fuzzes and prints the number of executions. If an input breaks a rule, fails with the command that repeats it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let (fuzz, out) = (workspace().join("fuzz"), workspace().join("target/fuzz"));
    let programs = build(&fuzz, &out)?;
    let all = TARGETS.map(String::from);
    let targets = if arguments.target.is_empty() { &all[..] } else { &arguments.target };
    for target in targets {
        println!("{target}: {} s ...", arguments.seconds);
        let executions = fuzz_target(target, arguments.seconds, &programs, &fuzz, &out)?;
        println!("{target}: {executions} executions, nothing found");
    }
    Ok(())
}

/// Builds all targets; returns their directory.
fn build(fuzz: &Path, out: &Path) -> anyhow::Result<PathBuf> {
    // Named although it is the default: this way the flags do not apply to build scripts.
    let host = tool::output(Command::new("rustc").args(["--print", "host-tuple"]))?;
    let host = host.trim();
    let mut cargo = cargo();
    cargo.args(["build", "--release", "--bins", "--target", host, "--target-dir"]).arg(out);
    tool::run(
        cargo.env("RUSTFLAGS", RUSTFLAGS).current_dir(fuzz),
        "the fuzz targets, which need a C++ compiler (`apt-get install g++`), do not build",
    )?;
    Ok(out.join(host).join("release"))
}

/// Runs one target; returns the number of its inputs.
fn fuzz_target(
    target: &str,
    seconds: u32,
    programs: &Path,
    fuzz: &Path,
    out: &Path,
) -> anyhow::Result<u64> {
    // libFuzzer writes to the first folder and only reads the second.
    let found = out.join("corpus").join(target);
    let artifacts = fuzz.join("artifacts").join(target);
    fs::create_dir_all(&found)?;
    fs::create_dir_all(&artifacts)?;
    let output = Command::new(programs.join(target))
        .arg(&found)
        .arg(fuzz.join("corpus").join(target))
        .arg(format!("-max_total_time={seconds}"))
        .arg(format!("-artifact_prefix={}/", artifacts.display()))
        .args(["-print_final_stats=1", "-verbosity=1"])
        .stdin(Stdio::null())
        .output()
        .with_context(|| format!("cannot run the fuzz target {target}"))?;
    let text = String::from_utf8_lossy(&output.stderr);
    if !output.status.success() {
        bail!(
            "{text}\n{target} failed, see above; repeat it with the file named there:\n    {} FILE",
            programs.join(target).display()
        );
    }
    text.lines()
        .find_map(|line| line.strip_prefix("stat::number_of_executed_units:"))
        .and_then(|number| number.trim().parse().ok())
        .context("libFuzzer did not print the number of executions")
}
