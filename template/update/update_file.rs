//! `cargo update-file [--key PEM] [FOLDER]`: builds loader and program, and writes the files with which they get onto boards
//! into `target/update`, or another folder. With a key, the owner of which signs the program.

use std::{env, error::Error, path::Path};

use @crate@::device::DEVICE;
use testkit::update;

fn main() -> Result<(), Box<dyn Error>> {
    let product = env::var_os("CARGO_MANIFEST_DIR").unwrap_or_default();
    let loader_key = None;
    Ok(update::run(Path::new(&product), "@name@", &DEVICE, loader_key)?)
}
