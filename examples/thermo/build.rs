//! Passes `memory.x` and the linker scripts to the linker.

use std::{env, fs, path::PathBuf};

fn main() {
    println!("cargo::rerun-if-changed=memory.x");
    if env::var("CARGO_CFG_TARGET_OS").as_deref() == Ok("none") {
        // Cargo corrects this path in a copy of the folder that has its `target`, and no other.
        let output = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
        fs::copy("memory.x", output.join("memory.x")).expect("OUT_DIR is writable");
        println!("cargo::rustc-link-arg-bins=-L{}", output.display());
        for arg in ["--nmagic", "--icf=all", "-Tlink.x", "-Tdefmt.x"] {
            println!("cargo::rustc-link-arg-bins={arg}");
        }
    }
}
