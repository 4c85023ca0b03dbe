//! Links the programs with `harness.x`.

use std::{env, fs, path::PathBuf};

fn main() {
    println!("cargo::rerun-if-changed=harness.x");
    // Cargo corrects this path in a copy of the folder that has its `target`, and no other.
    let output = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    let script = output.join("harness.x");
    fs::copy("harness.x", &script).expect("OUT_DIR is writable");
    println!("cargo::rustc-link-arg-bins=-T{}", script.display());
}
