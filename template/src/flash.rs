//! `cargo firmware` builds the firmware; `cargo flash` looks for probe-rs, then also writes it to a board, and shows its
//! log.

use std::{
    env,
    path::Path,
    process::{Command, ExitCode},
};

use canopen_stm32f4::chip::Chip;
use chip_build::cargo_for_the_chip;

fn main() -> ExitCode {
    // Of the aliases in .cargo/config.toml.
    let command = env::args().nth(1).unwrap_or_default();
    if command == "run" && Command::new("probe-rs").arg("--version").output().is_err() {
        eprintln!(
            "error: probe-rs is missing. Install it with `cargo install probe-rs-tools --locked`, or see \
             https://probe.rs/docs/getting-started/installation; no board at hand? Try `cargo test`"
        );
        return ExitCode::FAILURE;
    }
    let chip = Chip::of_manifest(include_str!("../Cargo.toml")).expect("the feature `chip` names one");
    let outcome = cargo_for_the_chip(Path::new("."), &command).and_then(|mut cargo| {
        cargo.args(["--release", "--features", "chip", "--bin", "@name@"]);
        cargo.env("PROBE_RS_CHIP", chip.probe_rs);
        cargo.args(env::args().skip(2)).status()
    });
    match outcome {
        Ok(status) if status.success() => ExitCode::SUCCESS,
        Ok(_) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}
