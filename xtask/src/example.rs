//! What the commands can build the firmware with: a CAN controller, an example of an application.

use anyhow::ensure;
use emulator::{chip::Part, image::Image};
use testkit::image::{self, BuildError};

/// An application that the firmware has in place of `src/application.rs`.
#[derive(Clone, Copy, clap::ValueEnum)]
pub enum Example {
    /// Digital and analogue I/O, `src/io.rs`
    Io,
}

/// The features of the firmware for a CAN controller, 1 for CAN1, and its own application or an example.
pub fn features(controller: u8, example: Option<Example>) -> Vec<&'static str> {
    let controller = match controller {
        2 => Some("can2"),
        3 => Some("can3"),
        _ => None,
    };
    let example = example.map(|Example::Io| "io");
    controller.into_iter().chain(example).collect()
}

/// Checks that the chip has the CAN controller.
///
/// # Errors
/// It does not; the message names the chips that do.
pub fn check_controller(chip: Part, controller: u8) -> anyhow::Result<()> {
    let has = |part: &Part| usize::from(controller) <= part.cans();
    let having = || Part::ALL.into_iter().filter(has).map(Part::name).collect::<Vec<_>>();
    ensure!(
        has(&chip),
        "{} has no CAN{controller}, only {} have",
        chip.name(),
        having().join(" and ")
    );
    Ok(())
}

/// Builds the firmware for `part` with these features.
///
/// # Errors
/// It does not build.
pub fn image(part: Part, controller: u8, example: Option<Example>) -> Result<Image, BuildError> {
    image::build_with_features(part, &features(controller, example))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chip_without_the_can_controller_is_refused() {
        check_controller(Part::Stm32f405, 2).expect("every chip has CAN2");
        check_controller(Part::Stm32f423, 3).expect("an STM32F423 has CAN3");
        let error = check_controller(Part::Stm32f446, 3).expect_err("no CAN3").to_string();
        assert_eq!(error, "stm32f446 has no CAN3, only stm32f413 and stm32f423 have");
    }
}
