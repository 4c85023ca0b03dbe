//! `cargo release-files [--check-reproducible] [FOLDER]`: builds the program, and writes the files for those who put it on
//! boards into `target/release-files`, or another folder.

use std::{path::Path, process::ExitCode};

use emulator::chip::Part;
use testkit::release::{self, Program};

#[path = "eds.rs"]
#[allow(dead_code, reason = "it is a program")]
mod eds;

fn main() -> ExitCode {
    release::run(&Program {
        folder: Path::new(env!("CARGO_MANIFEST_DIR")),
        package: "@name@",
        part: Part::@part@,
        name: "@name@",
        data_sheet: eds::sheet(),
    })
}
