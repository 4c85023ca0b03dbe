//! Passes `memory.x` and the linker scripts to the linker.

use std::env;

fn main() {
    println!("cargo::rerun-if-changed=memory.x");
    let folder = env::var("CARGO_MANIFEST_DIR").expect("cargo sets CARGO_MANIFEST_DIR");
    if env::var("CARGO_CFG_TARGET_OS").as_deref() == Ok("none") {
        for arg in [&format!("-L{folder}"), "-Tlink.x", "-Tdefmt.x", "--nmagic"] {
            println!("cargo::rustc-link-arg-bins={arg}");
        }
    }
}
