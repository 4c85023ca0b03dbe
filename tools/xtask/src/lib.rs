//! The commands that a product needs, and what `cargo verify` shares with them.

pub mod board;
pub mod chips;
mod controller;
pub mod dist;
pub mod eds;
pub mod emulate;
pub mod example;
pub mod flash;
pub mod new_product;
pub mod size;
pub mod tool;

use std::{
    io, panic,
    process::{self, ExitCode},
};

use anstyle::{AnsiColor, Style};

const ERROR: Style = AnsiColor::Red.on_default().bold();

/// Runs a command and prints its error, unless that is the end of the reader of its output.
pub fn run(command: impl FnOnce() -> anyhow::Result<()>) -> ExitCode {
    end_with_the_reader();
    match command() {
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
