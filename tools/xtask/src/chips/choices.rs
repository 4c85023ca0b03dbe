//! Choices of chip and pins: the legal ones build, and the others are refused with a remedy.

use std::{
    fs,
    path::Path,
    process::{Output, Stdio},
};

use anyhow::{Context, ensure};
use emulator::chip::{Part, Pin};
use testkit::cargo::{cargo_for_the_chip, workspace};

/// Checks all of them.
pub fn check() -> anyhow::Result<()> {
    for features in ["chip", "stm32f405,stm32f407"] {
        let output = cargo_check(workspace(), &["--bin", "firmware", "--features", features])?;
        let is_refused = stderr(&output).contains("choose one chip");
        ensure!(!output.status.success() && is_refused, "--features {features} is not refused");
    }
    for part in [Part::Stm32f405, Part::Stm32f413] {
        for controller in 1..=part.cans() {
            check_pins(part, controller)
                .with_context(|| format!("{} CAN{controller}", part.name()))?;
        }
    }
    Ok(())
}

/// A build accepts all pins that the data sheet gives to the controller, and none that it gives to another.
fn check_pins(part: Part, controller: usize) -> anyhow::Result<()> {
    let legal = part.can_pins(controller - 1).to_vec();
    let output = check_pairs(part, controller, &legal)?;
    ensure!(output.status.success(), "{}", stderr(&output));

    let others = (0..part.cans()).filter(|other| other + 1 != controller);
    let illegal: Vec<_> = others.flat_map(|other| part.can_pins(other)).copied().collect();
    let output = check_pairs(part, controller, &illegal)?;
    ensure!(!output.status.success(), "pins of other controllers are not refused");
    let messages = stderr(&output);
    for (line, pins) in ["receive", "transmit"].into_iter().zip([0, 1]) {
        for Pin(port, number) in illegal.iter().map(|pair| pair[pins].0) {
            let why = format!("Pin<'{port}', {number}>` cannot be the {line} pin");
            ensure!(messages.contains(&why), "no message: {why}");
        }
    }
    Ok(())
}

/// Checks a package with a function that assigns each of these pairs to the controller.
fn check_pairs(part: Part, controller: usize, pairs: &[[(Pin, u32); 2]]) -> anyhow::Result<Output> {
    let assign = |[(receive, _), (transmit, _)]: &[(Pin, u32); 2]| {
        let pin = |Pin(port, number): &Pin| format!("Pin<'{port}', {number}>");
        format!("    let _ = assign::<{}, {}>;\n", pin(transmit), pin(receive))
    };
    let assigned: String = pairs.iter().map(assign).collect();
    let library = format!(
        "#![no_std]\n\
         use canopen_stm32f4::can::{{CanPins, CanRx, CanTx}};\n\
         use stm32f4xx_hal::{{gpio::Pin, pac::CAN{controller}, rcc::Rcc}};\n\
         fn assign<T: CanTx<CAN{controller}>, R: CanRx<CAN{controller}>>(t: T, r: R, rcc: &mut Rcc) {{\n    \
         let _ = CanPins::<CAN{controller}>::new(t, r, rcc);\n}}\n\
         pub fn all() {{\n{assigned}}}\n",
    );
    let manifest = format!(
        "[package]\nname = \"pins\"\nversion = \"0.1.0\"\nedition = \"2024\"\n\n[workspace]\n\n[dependencies]\n\
         canopen-stm32f4 = {{ path = \"{}/boards/stm32f4\", features = [\"{}\"] }}\n\
         stm32f4xx-hal = {{ version = \"0.23.0\", features = [\"can\"] }}\n",
        workspace().display(),
        part.name(),
    );
    let folder = workspace().join("target/pins");
    fs::create_dir_all(folder.join("src"))?;
    fs::write(folder.join("Cargo.toml"), manifest)?;
    fs::write(folder.join("src/lib.rs"), library)?;
    fs::copy(workspace().join("Cargo.lock"), folder.join("Cargo.lock"))?;
    cargo_check(&folder, &[])
}

fn cargo_check(folder: &Path, arguments: &[&str]) -> anyhow::Result<Output> {
    cargo_for_the_chip(folder, "check")?
        .args(["--keep-going", "--release"])
        .args(arguments)
        .stdin(Stdio::null())
        .output()
        .context("cannot run cargo")
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}
