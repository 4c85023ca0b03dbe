//! `cargo verify commission`: the figures of `lss` on networks within the process.

use anyhow::{Context, ensure};
use testkit::cargo::cargo;

/// Measure `lss` on slaves within the process, in virtual time at 1 Mbit/s
///
/// It gives node-IDs to 127 blank slaves, in 5 s at most, and verifies 127 known ones, in 0.3 s. A mixed network of 20
/// slaves of ours and 2 foreign ones is commissioned in 100 random starts while frames are lost, power is cut and
/// another master interferes: in the end each slave has a node-ID of its own. In 200 runs, 32 boards change the bit
/// rate while one of them is pulled out at any moment: none is lost.
///
/// A run that fails is printed with the option that repeats it.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// A tenth of the random runs
    #[arg(long)]
    quick: bool,
    /// Seed of the campaign; random if not given
    #[arg(long)]
    seed: Option<u64>,
    /// Run only the mixed network with this seed, and print what `lss` prints
    #[arg(long, value_name = "SEED")]
    mixed: Option<u64>,
    /// Run only the rate change with this seed, and print what `lss` prints
    #[arg(long, value_name = "SEED")]
    rate: Option<u64>,
}

/// Runs the program of `commission` that measures, since nothing else here needs its dependencies.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let mut command = cargo();
    command.args(["run", "--quiet", "--package", "lss", "--example", "figures", "--"]);
    if arguments.quick {
        command.arg("--quick");
    }
    let numbers =
        [("--seed", arguments.seed), ("--mixed", arguments.mixed), ("--rate", arguments.rate)];
    for (name, number) in numbers {
        command.args(number.map(|number| format!("{name}={number}")));
    }
    let status = command.status().context("cargo does not run")?;
    ensure!(status.success(), "a goal is missed");
    Ok(())
}
