//! Passes the memory of the chip and the linker scripts to the linker.

use std::{env, fs, path::PathBuf};

fn main() {
    let memory =
        if env::var_os("CARGO_FEATURE_FDCAN").is_some() { "stm32g431.x" } else { "stm32f405.x" };
    println!("cargo::rerun-if-changed={memory}");
    let output = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    fs::copy(memory, output.join("memory.x")).expect("the memory is copied");
    println!("cargo::rustc-link-search={}", output.display());
    for arg in ["-Tlink.x", "-Tdefmt.x", "--nmagic"] {
        println!("cargo::rustc-link-arg-bins={arg}");
    }
}
