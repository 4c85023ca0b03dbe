//! The tables: all slaves side by side.

use super::{Measured, machine::Cost, session::Costs};

const HEADS: [[&str; 2]; 11] = [
    ["inquire", "(answer)"],
    ["select", "x4"],
    ["node-ID", ""],
    ["fastscan", "hit/miss"],
    ["scan", "x133"],
    ["identify", "x6"],
    ["foreign", "frame"],
    ["LSS", "module B"],
    ["LSS", "state B"],
    ["node", "B"],
    ["stack", "B"],
];
/// The number of columns that are costs of the CPU.
const COSTS: usize = 7;

/// Prints all tables.
pub fn print(measured: &[Measured]) {
    println!(
        "Instructions from the entry of `receive` to its return (to the request to transmit), at \
         opt-level 3; bytes at opt-level s"
    );
    head(HEADS.len());
    for slave in measured {
        row(slave.program.title(), &cells(slave, |cost| cost.instructions));
    }
    println!("\nCycles of the same, with a flash without wait states");
    head(COSTS);
    for slave in measured {
        row(slave.program.title(), &cells(slave, |cost| cost.cycles)[..COSTS]);
    }
}

fn head(columns: usize) {
    for line in 0..2 {
        row("", &HEADS.map(|head| head[line])[..columns]);
    }
}

fn row(title: &str, cells: &[impl AsRef<str>]) {
    print!("{title:26}");
    for cell in cells {
        print!("{:>11}", cell.as_ref());
    }
    println!();
}

fn cells(slave: &Measured, unit: fn(Cost) -> u64) -> [String; HEADS.len()] {
    let Costs { inquire, inquire_answered, fastscan_match, fastscan_no_match, .. } = slave.costs;
    let costs = &slave.costs;
    [
        format!("{} ({})", unit(inquire), unit(inquire_answered)),
        unit(costs.selective).to_string(),
        unit(costs.configure_node_id).to_string(),
        format!("{}/{}", unit(fastscan_match), unit(fastscan_no_match)),
        unit(costs.full_scan).to_string(),
        costs.identify.map_or_else(|| "none".to_owned(), |cost| unit(cost).to_string()),
        unit(costs.foreign).to_string(),
        number(slave.sizes.module),
        number(slave.sizes.state),
        number(slave.sizes.program),
        costs.stack.to_string(),
    ]
}

fn number(number: Option<u64>) -> String {
    number.map_or_else(String::new, |number| number.to_string())
}
