//! `cargo flash`: writes the firmware to a real board.

use canopen_stm32f4::chip::Chip;
use emulator::chip::Part;
use testkit::cargo::{cargo_for_the_chip, workspace};

use crate::{board::Board, example::Example, tool};

/// Write the firmware to a board, with probe-rs, and show its log
///
/// The log runs until Ctrl-C. The board is not halted at a reset or a fault, so that the log continues.
#[derive(clap::Args)]
pub struct Arguments {
    /// The chip on the board
    #[arg(default_value = testkit::image::PART.name())]
    chip: Part,
    /// In place of the chip: the board, with its clock and its LEDs
    #[arg(long, conflicts_with_all = ["chip", "example"])]
    board: Option<Board>,
    /// Write an example of a product in place of the plain firmware
    #[arg(long)]
    example: Option<Example>,
}

/// Builds the firmware, writes it to the connected board, and shows its log until Ctrl-C.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    tool::version(
        "probe-rs",
        "Install it with `cargo install probe-rs-tools --locked`, or see \
         https://probe.rs/docs/getting-started/installation; no board at hand? Try `cargo demo`",
    )?;
    let chip = Chip::named(arguments.chip.name()).expect("a test compares the names");
    let (features, probe_rs) = match arguments.board {
        Some(board) => (board.features(), board.probe_rs()),
        None => (chip.feature, chip.probe_rs),
    };
    let mut cargo = cargo_for_the_chip(workspace(), "run")?;
    if let Some(Board::NucleoG431rb) = arguments.board {
        cargo.args(["--manifest-path", "boards/embassy/Cargo.toml", "--no-default-features"]);
    } else {
        let package = Example::package(arguments.example);
        cargo.args(["--package", &package, "--bin", &package]);
    }
    tool::run(
        cargo.args(["--release", "--features", features]).env("PROBE_RS_CHIP", probe_rs),
        "the firmware was not written, or its run ended with an error",
    )
}
