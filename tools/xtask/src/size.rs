//! `cargo xtask size`: the flash and RAM of the firmware, compared with the budget in `size-budget.toml`.

use anyhow::bail;
use emulator::chip::Part;
use testkit::{elf, image};

use crate::example::Example;

/// Show the firmware's memory use, and check it against the budget
///
/// Fails if the flash takes more than tools/xtask/size-budget.toml allows.
#[derive(clap::Args)]
pub struct Arguments {
    /// The chip to build for
    #[arg(long, default_value = testkit::image::PART.name())]
    chip: Part,
    /// Show an example of a product, which has no budget
    #[arg(long)]
    example: Option<Example>,
}

/// Prints the sizes. Fails if they are above the budget.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let elf = image::build_elf(&Example::package(arguments.example), arguments.chip)?;
    let has_budget = arguments.example.is_none();
    let (report, flash) = elf::size(&elf, arguments.chip)?;
    print!("{report}");
    let budget = budget();
    if has_budget {
        println!("{:16} {budget:>8}", "budget");
    }
    if has_budget && flash > budget {
        bail!(
            "the firmware takes {} bytes more flash than tools/xtask/size-budget.toml allows",
            flash - budget
        );
    }
    Ok(())
}

/// The flash budget in bytes.
fn budget() -> u64 {
    let budget: toml::Table =
        include_str!("../size-budget.toml").parse().expect("size-budget.toml is TOML");
    let flash = budget["flash"].as_integer().expect("size-budget.toml gives flash in bytes");
    flash.try_into().expect("the budget is not negative")
}
