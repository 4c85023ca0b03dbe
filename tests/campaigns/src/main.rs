//! `cargo verify`: the campaigns and measurements that prove what the product does.

mod bench;
mod chip_variants;
mod conformance;
mod figures;
#[cfg(target_os = "linux")]
mod linux;
mod no_harm;
mod power_cut;
mod qemu;
mod storm;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

#[derive(Parser)]
#[command(
    name = "cargo verify",
    bin_name = "cargo verify",
    about = "The campaigns and measurements of the project",
    disable_help_subcommand = true
)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Bench(bench::Arguments),
    ChipVariants(chip_variants::Arguments),
    Conformance(conformance::Arguments),
    Figures(figures::Arguments),
    #[cfg(target_os = "linux")]
    Linux(linux::Arguments),
    NoHarm(no_harm::Arguments),
    PowerCut(power_cut::Arguments),
    Qemu(qemu::Arguments),
    Storm(storm::Arguments),
}

fn main() -> ExitCode {
    xtask::run(|| match Arguments::parse().command {
        Command::Bench(arguments) => bench::run(&arguments),
        Command::ChipVariants(arguments) => chip_variants::run(&arguments),
        Command::Conformance(arguments) => conformance::run(&arguments),
        Command::Figures(_) => figures::run(),
        #[cfg(target_os = "linux")]
        Command::Linux(arguments) => linux::run(&arguments),
        Command::NoHarm(arguments) => no_harm::run(&arguments),
        Command::PowerCut(arguments) => power_cut::run(&arguments),
        Command::Qemu(_) => qemu::run(),
        Command::Storm(arguments) => storm::run(&arguments),
    })
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    #[test]
    fn the_arguments_are_consistent() {
        super::Arguments::command().debug_assert();
    }
}
