//! Checks the choice of the chip, and passes the linker scripts and the sizes of the chip's memory to the linker. Does
//! nothing on the host.

use std::{env, fs, path::PathBuf};

#[path = "src/chip.rs"]
#[allow(dead_code, reason = "part of it is for the firmware")]
mod chip;

/// The places of an image in memory: on its own, and with a loader.
const SCRIPTS: [&str; 3] = ["image.x", "loader.x", "program.x"];

fn main() {
    for script in SCRIPTS {
        println!("cargo::rerun-if-changed={script}");
    }
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
    let is_signed = cfg!(feature = "signed");
    let run = chip.run(is_signed);
    if run.sectors == 0 {
        println!("cargo::error=the flash of {} has no room for signed programs", chip.feature);
        return;
    }
    let sizes = format!(
        "FLASH_SIZE = {}K;\nRAM_SIZE = {}K;\nRUN_OFFSET = {};\nRUN_SIZE = {}K;\nLOADER_SIZE = {}K;\n",
        chip.flash_kb,
        chip.ram_kb,
        // No address in the flash, which would pass for that of a function.
        run.address - 0x0800_0000,
        run.kb,
        if is_signed { 64 } else { 32 },
    );
    fs::write(out.join("chip.x"), sizes).expect("OUT_DIR is writable");
    // Cargo corrects this path in a copy of the folder that has its `target`, and no other.
    for script in SCRIPTS {
        fs::copy(script, out.join(script)).expect("OUT_DIR is writable");
    }
    println!("cargo::rustc-link-search={}", out.display());
}
