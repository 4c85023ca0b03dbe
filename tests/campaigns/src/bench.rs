//! `cargo verify bench`: the cost of this project's LSS slave and node and of others, in instructions and bytes.

mod machine;
mod programs;
mod session;

use machine::Cost;
use programs::{Builds, PROGRAMS, Program};
use session::{Column, Costs, LSS, NODE};

/// Show the cost of the LSS slave and of the node in instructions and bytes, compared with others
///
/// Each slave is built in the same harness and runs on an emulated Cortex-M4. docs/size-and-speed.md explains the tables.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {}

/// The heads of the columns with sizes.
const SIZES: [[&str; 2]; 4] =
    [["LSS", "module B"], ["LSS", "state B"], ["node", "B"], ["stack", "B"]];

/// Builds all slaves in one harness, measures them and prints the figures. The same sources give the same figures.
///
/// # Errors
/// A slave cannot be built, or does not give the measured service.
pub fn run(Arguments {}: &Arguments) -> anyhow::Result<()> {
    let builds = Builds::make()?;
    let lss = measure(&builds, PROGRAMS.iter(), &LSS)?;
    let node = measure(&builds, PROGRAMS.iter().filter(|program| program.is_node), &NODE)?;
    println!(
        "Instructions from the entry of `receive` to its return (to the request to transmit), at \
         opt-level 3; bytes at opt-level s"
    );
    head(&[&heads(&LSS)[..], &SIZES].concat());
    for (program, costs) in &lss {
        let of_node = node.iter().find(|(other, _)| other.title == program.title);
        let stack = of_node.map_or(0, |(_, costs)| costs.stack).max(costs.stack);
        let [module, state, whole] = builds.sizes(program)?;
        let sizes = [module, state, whole, Some(stack.into())];
        let sizes = sizes.map(|size| size.map_or_else(String::new, |bytes| bytes.to_string()));
        row(program.title, &[costs.cells(), sizes.into()].concat());
    }
    head(&heads(&NODE));
    for (program, costs) in &node {
        row(program.title, &costs.cells());
    }
    Ok(())
}

/// A program with the costs of its services.
type Measured = (&'static Program, Costs);

fn measure(
    builds: &Builds,
    programs: impl Iterator<Item = &'static Program>,
    columns: &[Column],
) -> anyhow::Result<Vec<Measured>> {
    programs.map(|program| Ok((program, Costs::measure(&builds.fast(program), columns)?))).collect()
}

fn heads(columns: &[Column]) -> Vec<[&'static str; 2]> {
    columns.iter().map(|(head, _)| *head).collect()
}

fn head(heads: &[[&str; 2]]) {
    for line in 0..2 {
        row("", &heads.iter().map(|head| head[line].to_owned()).collect::<Vec<_>>());
    }
}

fn row(title: &str, cells: &[String]) {
    print!("{title:26}");
    for cell in cells {
        print!("{cell:>11}");
    }
    println!();
}

impl Costs {
    /// The cells of a row.
    fn cells(&self) -> Vec<String> {
        let cell = |costs: &Vec<Cost>| match &costs[..] {
            [] => "none".to_owned(),
            costs => costs.iter().map(|cost| cost.to_string()).collect::<Vec<_>>().join("/"),
        };
        self.costs.iter().map(cell).collect()
    }
}
