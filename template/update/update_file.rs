//! `cargo update-file`: builds loader and program, and writes the files with which they get onto boards into
//! `target/update`, or another folder.

use std::{env, error::Error, path::PathBuf};

use @crate@::device::DEVICE;
use emulator::chip::Part;
use testkit::update;

fn main() -> Result<(), Box<dyn Error>> {
    let product = env::var_os("CARGO_MANIFEST_DIR").map(PathBuf::from).unwrap_or_default();
    let folder = env::args_os().nth(1).map(PathBuf::from);
    let folder = folder.unwrap_or_else(|| product.join("target/update"));
    Ok(update::write(&product, &folder, "@name@", &DEVICE, Part::@part@, @controller@)?)
}
