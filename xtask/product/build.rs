//! Adds the firmware's drivers to the program, and passes `memory.x` to the linker.

use std::{
    env, fs,
    path::{Path, PathBuf},
};

fn main() {
    println!("cargo::rerun-if-changed=memory.x");
    println!("cargo::rerun-if-changed=src");
    // The build script of the firmware sets it, when the program is built for the chip.
    let Some(firmware) = env::var_os("DEP_LSS_SLAVE_FIRMWARE_SOURCES") else {
        return;
    };
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    fs::write(out.join("drivers.rs"), drivers(Path::new(&firmware))).expect("OUT_DIR is writable");
    let folder = env::var("CARGO_MANIFEST_DIR").expect("cargo sets CARGO_MANIFEST_DIR");
    for arg in [&format!("-L{folder}"), "-Tlink.x", "-Tdefmt.x", "--nmagic"] {
        println!("cargo::rustc-link-arg-bins={arg}");
    }
}

/// The declarations of the modules that the firmware's `main.rs` declares for every build, except those that the product
/// has itself.
fn drivers(firmware: &Path) -> String {
    let main = firmware.join("main.rs");
    println!("cargo::rerun-if-changed={}", main.display());
    let main = fs::read_to_string(main).expect("the firmware has its main.rs");
    let mut declarations = String::new();
    let mut is_conditional = false;
    for line in main.lines() {
        let module = line.strip_prefix("mod ").and_then(|line| line.strip_suffix(';'));
        if let Some(module) = module
            && !is_conditional
            && !Path::new("src").join(module).with_extension("rs").exists()
        {
            let path = firmware.join(module).with_extension("rs");
            declarations += &format!("#[path = {path:?}]\nmod {module};\n");
        }
        is_conditional = line.starts_with("#[cfg");
    }
    declarations
}
