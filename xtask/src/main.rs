//! The commands of the project: `cargo emulate`, `cargo flash`,
//! `cargo xtask bench`, `cargo xtask chips`, `cargo xtask coverage`, `cargo xtask eds`, `cargo xtask figures`,
//! `cargo xtask fuzz`,
//! `cargo xtask linux`, `cargo xtask new-product`, `cargo xtask no-harm`, `cargo xtask power-cut`, `cargo xtask qemu`,
//! `cargo xtask readings`, `cargo xtask release`, `cargo xtask size`, `cargo xtask soak`, `cargo xtask storm`.

mod bench;
mod chips;
mod controller;
mod coverage;
mod eds;
mod emulate;
mod example;
mod figures;
mod flash;
mod fuzz;
mod generated;
#[cfg(target_os = "linux")]
mod linux;
mod new_product;
mod no_harm;
mod parallel;
mod power_cut;
mod qemu;
mod readings;
mod release;
mod size;
mod soak;
mod storm;

use std::{
    io, panic,
    process::{self, ExitCode},
};

use anstyle::{AnsiColor, Style};
use clap::{Parser, Subcommand};

const ERROR: Style = AnsiColor::Red.on_default().bold();

#[derive(Parser)]
#[command(
    name = "cargo xtask",
    bin_name = "cargo xtask",
    about = "The commands of the project",
    after_help = "`cargo emulate` and `cargo flash` are short for these commands.",
    disable_help_subcommand = true
)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Bench(bench::Arguments),
    Chips(chips::Arguments),
    Coverage(coverage::Arguments),
    Eds(eds::Arguments),
    Emulate(emulate::Arguments),
    Figures(figures::Arguments),
    Flash(flash::Arguments),
    Fuzz(fuzz::Arguments),
    #[cfg(target_os = "linux")]
    Linux(linux::Arguments),
    NewProduct(new_product::Arguments),
    NoHarm(no_harm::Arguments),
    PowerCut(power_cut::Arguments),
    Qemu(qemu::Arguments),
    Readings(readings::Arguments),
    Release(release::Arguments),
    Size(size::Arguments),
    Soak(soak::Arguments),
    Storm(storm::Arguments),
}

fn main() -> ExitCode {
    end_with_the_reader();
    let outcome = match Arguments::parse().command {
        Command::Bench(arguments) => bench::run(&arguments),
        Command::Chips(arguments) => chips::run(&arguments),
        Command::Coverage(arguments) => coverage::run(&arguments),
        Command::Eds(arguments) => eds::run(&arguments),
        Command::Emulate(arguments) => emulate::run(&arguments),
        Command::Figures(_) => figures::run(),
        Command::Flash(arguments) => flash::run(&arguments),
        Command::Fuzz(arguments) => fuzz::run(&arguments),
        #[cfg(target_os = "linux")]
        Command::Linux(arguments) => linux::run(&arguments),
        Command::NewProduct(arguments) => new_product::run(&arguments),
        Command::NoHarm(arguments) => no_harm::run(&arguments),
        Command::PowerCut(arguments) => power_cut::run(&arguments),
        Command::Qemu(_) => qemu::run(),
        Command::Readings(arguments) => readings::run(&arguments),
        Command::Release(arguments) => release::run(&arguments),
        Command::Size(arguments) => size::run(&arguments),
        Command::Soak(arguments) => soak::run(&arguments),
        Command::Storm(arguments) => storm::run(&arguments),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) if is_broken_pipe(&error) => ExitCode::FAILURE,
        Err(error) => {
            anstream::eprintln!("{ERROR}error:{ERROR:#} {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Ends the program without a message when `println!` finds that the reader of the output, such as `head`, has closed
/// it. The exit status is that of a failure: the command has not done all of its work.
fn end_with_the_reader() {
    let report = panic::take_hook();
    panic::set_hook(Box::new(move |info| match info.payload_as_str() {
        Some(text) if text.starts_with("failed printing to stdout: Broken pipe") => {
            process::exit(1)
        }
        _ => report(info),
    }));
}

/// Whether the reader of the output, such as `head`, has closed it.
fn is_broken_pipe(error: &anyhow::Error) -> bool {
    error.downcast_ref::<io::Error>().is_some_and(|error| error.kind() == io::ErrorKind::BrokenPipe)
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    #[test]
    fn the_arguments_are_consistent() {
        super::Arguments::command().debug_assert();
    }
}
