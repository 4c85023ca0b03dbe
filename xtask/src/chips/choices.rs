//! Choices of chip, CAN controller and pins: the legal ones build, and the others are refused with a remedy.

use std::{
    env,
    process::{Command, Output, Stdio},
};

use anyhow::{Context, ensure};
use emulator::chip::{Part, Pin};

use crate::{apart, example};

/// Features that do not go together, and a part of the message.
const REFUSED: [(&str, &str); 4] = [
    ("chip", "choose one chip"),
    ("stm32f405,stm32f407", "choose one chip"),
    ("stm32f405,can3", "stm32f405 has no CAN3, only stm32f413 and stm32f423 have"),
    ("stm32f413,can2,can3", "choose one of the features can2 and can3"),
];

/// Checks all of them.
pub fn check() -> anyhow::Result<()> {
    for (features, why) in REFUSED {
        let output = cargo_check(features, None)?;
        let is_refused = stderr(&output).contains(why);
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
    let features =
        [vec![part.name()], example::features(controller as u8, None)].concat().join(",");
    let legal = part.can_pins(controller - 1).to_vec();
    let output = cargo_check(&features, Some(&pairs(&legal)))?;
    ensure!(output.status.success(), "{}", stderr(&output));

    let others = (0..part.cans()).filter(|other| other + 1 != controller);
    let illegal: Vec<_> = others.flat_map(|other| part.can_pins(other)).copied().collect();
    let output = cargo_check(&features, Some(&pairs(&illegal)))?;
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

/// A function that assigns each of these pairs.
fn pairs(pairs: &[[(Pin, u32); 2]]) -> String {
    let assign = |[(receive, _), (transmit, _)]: &[(Pin, u32); 2]| {
        let pin = |Pin(port, number): &Pin| format!("stm32f4xx_hal::gpio::Pin<'{port}', {number}>");
        format!("legal::<{}, {}>();", pin(transmit), pin(receive))
    };
    let assigned: String = pairs.iter().map(assign).collect();
    format!(
        "const _: () = {{\n\
         const fn legal<T: crate::can_pins::Transmits, R: crate::can_pins::Receives>() {{}}\n\
         {assigned}\n}};\n"
    )
}

/// Checks the firmware with these features, as it is or with code appended to `src/pins.rs`.
fn cargo_check(features: &str, code: Option<&str>) -> anyhow::Result<Output> {
    const PINS: &str = "src/pins.rs";
    let mut command = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command
        .args(["check", "--keep-going", "--release", "--target", "thumbv7em-none-eabihf"])
        .args(["--package", "lss-slave-firmware", "--bin", "lss-slave", "--features", features])
        .stdin(Stdio::null());
    if let Some(code) = code {
        let copy = apart::copy("chips/pins", PINS, &(apart::source(PINS)? + code))?;
        command.arg("--target-dir").arg(copy.join("target")).current_dir(copy);
    }
    command.output().context("cannot run cargo")
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}
