//! `cargo verify bench`: the cost of this project's LSS slave and of others, in instructions, cycles and bytes.

mod machine;
mod programs;
mod report;
mod session;
mod sizes;

use programs::Program;
use session::Costs;
use sizes::Sizes;

/// Show the cost of the LSS slave in instructions and bytes, compared with others
///
/// Each slave is built in the same harness and runs on an emulated Cortex-M4. docs/size-and-speed.md explains the tables.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {}

/// The measurements of one slave.
struct Measured {
    program: Program,
    costs: Costs,
    sizes: Sizes,
}

/// Builds all slaves in one harness, measures them and prints the figures. The same sources give the same figures.
///
/// # Errors
/// A slave cannot be built, or does not give the measured service.
pub fn run(Arguments {}: &Arguments) -> anyhow::Result<()> {
    let builds = programs::build()?;
    let measured = Program::ALL
        .into_iter()
        .map(|program| {
            let costs = Costs::measure(&builds.fast(program))?;
            let sizes = Sizes::measure(program, &builds)?;
            Ok(Measured { program, costs, sizes })
        })
        .collect::<anyhow::Result<Vec<_>>>()?;
    report::print(&measured);
    Ok(())
}
