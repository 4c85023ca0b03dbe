//! Checks the choice of the chip and of its CAN controller, and passes `memory.x`, the sizes of the chip's memory and
//! the linker scripts to the linker. Does nothing on the host, where only the tests are built.

use std::{env, fs, path::PathBuf};

#[path = "src/chip.rs"]
#[allow(dead_code, reason = "part of it is for the firmware")]
mod chip;

fn main() {
    println!("cargo::rerun-if-changed=memory.x");
    if env::var("CARGO_CFG_TARGET_OS").as_deref() != Ok("none") {
        return;
    }
    let selected: Vec<_> = chip::CHIPS.iter().filter(|chip| chip.is_selected).collect();
    let [chip] = selected[..] else {
        let names = chip::CHIPS.map(|chip| chip.feature).join(", ");
        println!("cargo::error=choose one chip, with `--features`: {names}");
        return;
    };
    if cfg!(all(feature = "can2", feature = "can3")) {
        println!("cargo::error=choose one of the features can2 and can3, or none of them for CAN1");
        return;
    }
    if chip.controllers < chip::CONTROLLER {
        let having = chip::CHIPS.iter().filter(|chip| chip.controllers >= chip::CONTROLLER);
        let names = having.map(|chip| chip.feature).collect::<Vec<_>>().join(" and ");
        println!(
            "cargo::error={} has no CAN{}, only {names} have: choose can2, or no such feature for CAN1",
            chip.feature,
            chip::CONTROLLER
        );
        return;
    }
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    let sizes = format!("FLASH_SIZE = {}K;\nRAM_SIZE = {}K;\n", chip.flash_kb, chip.ram_kb);
    fs::write(out.join("chip.x"), sizes).expect("OUT_DIR is writable");
    println!("cargo::rustc-link-search={}", out.display());
    let folder = env::var("CARGO_MANIFEST_DIR").expect("cargo sets CARGO_MANIFEST_DIR");
    for arg in [&format!("-L{folder}"), "-Tlink.x", "-Tdefmt.x", "--nmagic"] {
        println!("cargo::rustc-link-arg-bins={arg}");
    }
    // A product takes its drivers from there: xtask/product/build.rs.
    println!("cargo::metadata=sources={folder}/src");
}
