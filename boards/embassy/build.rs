//! Passes the memory of the chip and the linker scripts to the linker.

use std::{env, fs, path::PathBuf};

fn main() {
    let chip = env::vars()
        .find_map(|(name, _)| Some(format!("stm32{}", name.strip_prefix("CARGO_FEATURE_STM32")?)))
        .expect("the feature of a chip")
        .to_lowercase();
    let memory = format!("{chip}.x");
    println!("cargo::rerun-if-changed={memory}");
    let output = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    fs::copy(memory, output.join("memory.x")).expect("the file is there");
    for argument in [&format!("-L{}", output.display()), "-Tlink.x", "-Tdefmt.x", "--nmagic"] {
        println!("cargo::rustc-link-arg-bins={argument}");
    }
}
