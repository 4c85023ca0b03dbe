//! `cargo release-files [--check-reproducible] [FOLDER]`: builds the program, and writes the files for those who put it on
//! boards into `target/release-files`, or another folder.

use std::{path::Path, process::ExitCode};

use testkit::release;

#[path = "eds.rs"]
#[allow(dead_code, reason = "it is a program")]
mod eds;

fn main() -> ExitCode {
    release::run(Path::new(env!("CARGO_MANIFEST_DIR")), "@name@", eds::sheet())
}
