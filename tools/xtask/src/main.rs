//! `cargo xtask`, `cargo emulate` and `cargo flash`: the commands that a product needs.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use xtask::{chips, dist, eds, emulate, flash, new_product, size};

#[derive(Parser)]
#[command(
    name = "cargo xtask",
    bin_name = "cargo xtask",
    about = "The commands of the project",
    after_help = "`cargo emulate` and `cargo flash` are short for these commands. `cargo verify` lists the campaigns \
                  and measurements.",
    disable_help_subcommand = true
)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Chips(chips::Arguments),
    Dist(dist::Arguments),
    Eds(eds::Arguments),
    Emulate(emulate::Arguments),
    Flash(flash::Arguments),
    NewProduct(new_product::Arguments),
    Size(size::Arguments),
}

fn main() -> ExitCode {
    xtask::run(|| match Arguments::parse().command {
        Command::Chips(arguments) => chips::run(&arguments),
        Command::Dist(arguments) => dist::run(&arguments),
        Command::Eds(arguments) => eds::run(&arguments),
        Command::Emulate(arguments) => emulate::run(&arguments),
        Command::Flash(arguments) => flash::run(&arguments),
        Command::NewProduct(arguments) => new_product::run(&arguments),
        Command::Size(arguments) => size::run(&arguments),
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
