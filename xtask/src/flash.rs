//! `cargo flash`: writes the firmware to a real board.

use std::{
    env, io,
    process::{Command, Stdio},
};

use anyhow::{Context, bail};
use emulator::chip::Part;
use lss_slave_firmware::chip::{self, Chip};

use crate::example;

/// Write the firmware to a board, with probe-rs, and show its log
///
/// The log runs until Ctrl-C. The board is not halted at a reset or a fault, so that the log continues.
#[derive(clap::Args)]
pub struct Arguments {
    /// The chip on the board
    #[arg(default_value = "stm32f405")]
    chip: Part,
    /// The CAN controller: can1, can2, or on some chips can3
    #[arg(long, default_value = "can1", value_parser = chip::controller)]
    controller: u8,
}

/// Builds the firmware, writes it to the connected board, and shows its log until Ctrl-C.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    example::check_controller(arguments.chip, arguments.controller)?;
    find_probe_rs()?;
    let chip = Chip::named(arguments.chip.name()).expect("a test compares the names");
    let mut features = example::features(arguments.controller, None);
    features.push(chip.feature);
    let cargo = env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let status = Command::new(cargo)
        .args(["run", "--release", "--target", "thumbv7em-none-eabihf"])
        .args(["--package", "lss-slave-firmware", "--bin", "lss-slave"])
        .args(["--features", &features.join(",")])
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
