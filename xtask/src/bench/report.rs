//! The tables: all slaves side by side, those measured elsewhere quoted as such, and this project's targets.

use super::{Measured, machine::Cost, programs::Program, session::Costs};

/// The other slaves whose figures are quoted.
const QUOTED: [(&str, [&str; 11]); 4] = [
    (
        "CANopenNode",
        ["164 (131)", "504", "170", "190/129", "22535", "none", "", "954", "155", "4676", "108"],
    ),
    (
        "embedded-office",
        ["318 (286)", "951", "181", "430/384", "53634", "2002", "", "1666", "16", "10752", "112"],
    ),
    (
        "Lely",
        ["336 (284)", "1358", "306", "596/550", "76934", "2077", "", "1834", "88", "18004", "216"],
    ),
    (
        "CanFestival",
        ["136 (109)", "400", "96", "131/74", "14949", "534", "26", "1640", "68", "12581", "200"],
    ),
];

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
/// So many of them are costs of the CPU.
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
    println!(
        "Not of this run: C at -O2 and -Os in a longer harness, in which canopen-rs LssSlave alone \
         took 58 (38) to inquire"
    );
    for (title, cells) in &QUOTED {
        row(title, cells);
    }
    println!("\nCycles of the same, with a flash without wait states");
    head(COSTS);
    for slave in measured {
        row(slave.program.title(), &cells(slave, |cost| cost.cycles)[..COSTS]);
    }
    let [node, alone] = [Program::Node, Program::Slave].map(|program| {
        measured.iter().find(|slave| slave.program == program).expect("both are measured")
    });
    println!("\nTargets of this project{:11}most{:>12}{:>16}", "", "node", "Slave alone");
    for Target { title, limit, of } in TARGETS {
        let [node, alone] = [node, alone].map(|slave| match of(slave) {
            Some(number) if number <= limit => format!("{number} met"),
            Some(number) => format!("{number} missed"),
            None => String::new(),
        });
        println!("{title:26}{limit:>12}{node:>16}{alone:>16}");
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

/// What this project wants of itself.
struct Target {
    title: &'static str,
    limit: u64,
    of: fn(&Measured) -> Option<u64>,
}

const TARGETS: [Target; 12] = [
    target("inquire vendor", 85, |slave| instructions(slave.costs.inquire)),
    target("  to the answer", 60, |slave| instructions(slave.costs.inquire_answered)),
    target("selective x4", 170, |slave| instructions(slave.costs.selective)),
    target("fastscan match", 85, |slave| instructions(slave.costs.fastscan_match)),
    target("fastscan no match", 50, |slave| instructions(slave.costs.fastscan_no_match)),
    target("full scan x133", 9_000, |slave| instructions(slave.costs.full_scan)),
    target("identify x6", 270, |slave| slave.costs.identify.and_then(instructions)),
    target("foreign frame", 14, |slave| instructions(slave.costs.foreign)),
    target("LSS module, bytes", 950, |slave| slave.sizes.module),
    target("LSS state, bytes", 32, |slave| slave.sizes.state),
    target("smallest node, bytes", 4_600, |slave| slave.sizes.program),
    target("stack, bytes", 100, |slave| Some(slave.costs.stack.into())),
];

const fn target(title: &'static str, limit: u64, of: fn(&Measured) -> Option<u64>) -> Target {
    Target { title, limit, of }
}

fn instructions(cost: Cost) -> Option<u64> {
    Some(cost.instructions)
}
