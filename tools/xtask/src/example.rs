//! The examples of products, which the commands can run in place of the plain firmware.

use emulator::{
    board::Settings,
    can::Clock,
    chip::{ChipVariant, Part},
    image::Image,
};
use testkit::image;

/// An example of a product.
#[derive(Clone, Copy, clap::ValueEnum)]
pub enum Example {
    /// An LSS master, `examples/commissioner`
    Commissioner,
    /// Digital and analogue I/O, `examples/io`
    Io,
}

impl Example {
    /// The name of its folder.
    fn name(self) -> &'static str {
        match self {
            Self::Commissioner => "commissioner",
            Self::Io => "io",
        }
    }

    /// The package of an example, or of the plain firmware.
    pub fn package(example: Option<Self>) -> String {
        example.map_or("firmware".to_owned(), |example| format!("example-{}", example.name()))
    }
}

/// The board of an example, or of the plain firmware, with its crystal.
pub fn board(example: Option<Example>) -> Settings {
    macro_rules! clock {
        ($product:ident) => {
            ($product::device::CRYSTAL_HZ, $product::device::CRYSTAL_IS_EXTERNAL_CLOCK)
        };
    }
    let (hz, external_clock) = match example {
        None => clock!(firmware),
        // That of an STM32F407 Discovery.
        Some(Example::Commissioner) => (8_000_000, false),
        Some(Example::Io) => clock!(example_io),
    };
    let chip_variant = ChipVariant { external_clock, ..ChipVariant::default() };
    Settings { crystal: Clock { hz, ppm: 0 }, chip_variant, ..Settings::default() }
}

/// Builds the plain firmware or an example.
///
/// # Errors
/// It does not build for this chip.
pub fn image(chip: Part, example: Option<Example>) -> anyhow::Result<Image> {
    match example {
        None => image::build(chip),
        Some(example) => image::build_example(example.name(), chip),
    }
}
