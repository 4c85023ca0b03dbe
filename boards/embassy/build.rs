//! Passes the memory of the chip and the linker scripts to the linker.

use std::{env, fs, path::PathBuf};

/// The chips, by feature.
const CHIPS: [&str; 7] =
    ["stm32f105", "stm32f407", "stm32f767", "stm32g431", "stm32g474", "stm32h743", "stm32l476"];

fn main() {
    let is_chosen =
        |chip: &&&str| env::var_os(format!("CARGO_FEATURE_{}", chip.to_uppercase())).is_some();
    let chip = CHIPS.iter().find(is_chosen).expect("the feature of a chip");
    let memory = format!("{chip}.x");
    println!("cargo::rerun-if-changed={memory}");
    let output = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    fs::copy(memory, output.join("memory.x")).expect("the file is there");
    for argument in [&format!("-L{}", output.display()), "-Tlink.x", "-Tdefmt.x", "--nmagic"] {
        println!("cargo::rustc-link-arg-bins={argument}");
    }
}
