//! `cargo flash`: looks for probe-rs, then builds the firmware, writes it to a board, and shows its log.

use std::{
    env,
    process::{Command, ExitCode},
};

fn main() -> ExitCode {
    if Command::new("probe-rs").arg("--version").output().is_err() {
        eprintln!(
            "error: probe-rs is missing. Install it with `cargo install probe-rs-tools --locked`, or see \
             https://probe.rs/docs/getting-started/installation; no board at hand? Try `cargo test`"
        );
        return ExitCode::FAILURE;
    }
    let mut cargo = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    cargo.args(["run", "--release", "--target", "thumbv7em-none-eabihf"]);
    cargo.args(["--features", "@chip@", "--bin", "@name@"]);
    match cargo.status() {
        Ok(status) if status.success() => ExitCode::SUCCESS,
        _ => ExitCode::FAILURE,
    }
}
