//! Passes `memory.x` and the linker scripts to the linker.

use std::env;

fn main() {
    println!("cargo::rerun-if-changed=memory.x");
    let directory = env::var("CARGO_MANIFEST_DIR").expect("cargo sets it");
    println!("cargo::rustc-link-search={directory}");
    for arg in ["-Tlink.x", "-Tdefmt.x", "--nmagic"] {
        println!("cargo::rustc-link-arg-bins={arg}");
    }
}
