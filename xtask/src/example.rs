//! The examples of an application that the commands can run.

use emulator::{chip::Part, image::Image};
use testkit::image::{self, BuildError};

/// An application that the firmware has in place of `src/application.rs`.
#[derive(Clone, Copy, clap::ValueEnum)]
pub enum Example {
    /// Digital and analogue I/O, `src/io.rs`
    Io,
}

/// Builds the firmware for `part`, with its own application or an example.
///
/// # Errors
/// It does not build.
pub fn image(part: Part, example: Option<Example>) -> Result<Image, BuildError> {
    match example {
        None => image::build(part),
        Some(Example::Io) => image::build_with_features(part, &["io"]),
    }
}
