//! Checks the choice of the chip, and passes `image.x` and the sizes of the chip's memory to the linker. Does nothing on
//! the host.

use std::{env, fs, path::PathBuf};

#[path = "src/chip.rs"]
#[allow(dead_code, reason = "part of it is for the firmware")]
mod chip;

fn main() {
    println!("cargo::rerun-if-changed=image.x");
    println!("cargo::rerun-if-changed=src/chip.rs");
    if env::var("CARGO_CFG_TARGET_OS").as_deref() != Ok("none") {
        return;
    }
    let selected: Vec<_> = chip::CHIPS.iter().filter(|chip| chip.is_selected).collect();
    let [chip] = selected[..] else {
        let names = chip::CHIPS.map(|chip| chip.feature).join(", ");
        println!("cargo::error=choose one chip, with `--features`: {names}");
        return;
    };
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    let sizes = format!("FLASH_SIZE = {}K;\nRAM_SIZE = {}K;\n", chip.flash_kb, chip.ram_kb);
    fs::write(out.join("chip.x"), sizes).expect("OUT_DIR is writable");
    // Cargo corrects this path in a copy of the folder that has its `target`, and no other.
    fs::copy("image.x", out.join("image.x")).expect("OUT_DIR is writable");
    println!("cargo::rustc-link-search={}", out.display());
}
