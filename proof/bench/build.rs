//! Links the programs with `harness.x`.

use std::{env, path::Path};

fn main() {
    let directory = env::var("CARGO_MANIFEST_DIR").expect("cargo sets it");
    let script = Path::new(&directory).join("harness.x");
    println!("cargo::rerun-if-changed=harness.x");
    println!("cargo::rustc-link-arg-bins=-T{}", script.display());
}
