//! `cargo flash`: writes the firmware to a real board.

use std::{
    io,
    process::{Command, Stdio},
};

use anyhow::{Context, bail};
use canopen_stm32f4::chip::Chip;
use emulator::chip::Part;
use testkit::cargo::cargo_for_the_chip;

use crate::example::{self, Example};

/// Write the firmware to a board, with probe-rs, and show its log
///
/// The log runs until Ctrl-C. The board is not halted at a reset or a fault, so that the log continues.
#[derive(clap::Args)]
pub struct Arguments {
    /// The chip on the board [default: stm32f405, or that of the example]
    chip: Option<Part>,
    /// Write an example of a product in place of the plain firmware
    #[arg(long)]
    example: Option<Example>,
}

/// Builds the firmware, writes it to the connected board, and shows its log until Ctrl-C.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    find_probe_rs()?;
    let part = example::chip(arguments.chip, arguments.example);
    let chip = Chip::named(part.name()).expect("a test compares the names");
    let package = Example::package(arguments.example);
    let status = cargo_for_the_chip("run")
        .args(["--release", "--package", &package, "--bin", &package, "--features", chip.feature])
        .env("PROBE_RS_CHIP", chip.probe_rs)
        .status()
        .context("cannot run cargo")?;
    if !status.success() {
        bail!("the firmware was not written, or its run ended with an error: see above");
    }
    Ok(())
}

fn find_probe_rs() -> anyhow::Result<()> {
    let version = Command::new("probe-rs").arg("--version").stdout(Stdio::null()).status();
    match version {
        Err(error) if error.kind() == io::ErrorKind::NotFound => bail!(
            "probe-rs is missing. Install it with `cargo install probe-rs-tools --locked`, or see \
             https://probe.rs/docs/getting-started/installation; no board at hand? Try `cargo demo`"
        ),
        Err(error) => Err(error).context("cannot run probe-rs"),
        Ok(_) => Ok(()),
    }
}
