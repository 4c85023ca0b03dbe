//! What the commands can build the firmware with: a CAN controller, an example of an application.

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

/// Builds the firmware for `part` with these features.
///
/// # Errors
/// It does not build.
pub fn image(part: Part, controller: u8, example: Option<Example>) -> Result<Image, BuildError> {
    image::build_with_features(part, &features(controller, example))
}
