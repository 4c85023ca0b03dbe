//! The plain slave: the firmware without bit-rate supervision, built apart from the product, which it does not change.

use anyhow::bail;
use emulator::{chip::Part, image::Image};

use crate::apart;

/// The changed line, before and after.
const SWITCH: (&str, &str) = ("pub const RESCUE: bool = true;", "pub const RESCUE: bool = false;");
const SWITCH_FILE: &str = "src/device.rs";

/// Builds it in `target/no-harm/plain`.
pub fn build(part: Part) -> anyhow::Result<Image> {
    let device = apart::source(SWITCH_FILE)?;
    let copy = apart::copy("no-harm/plain", SWITCH_FILE, &without_rescue(&device)?)?;
    Ok(testkit::image::build_in(&copy, part)?)
}

/// `device.rs` with supervision switched off.
fn without_rescue(device: &str) -> anyhow::Result<String> {
    let (on, off) = SWITCH;
    match device.matches(on).count() {
        1 => Ok(device.replace(on, off)),
        count => bail!(
            "{SWITCH_FILE} has the line `{on}` {count} times, not once: the plain slave is the firmware with \
             that line changed. If the switch has another name, change it in xtask/src/no_harm/plain.rs too"
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_that_makes_the_plain_slave_must_be_there_once() {
        let line = SWITCH.0;
        assert_eq!(without_rescue(line).expect("once"), SWITCH.1);
        for device in [String::new(), format!("{line}\n{line}")] {
            let error = without_rescue(&device).expect_err("not once").to_string();
            assert!(error.contains("not once"), "{error}");
        }
    }
}
