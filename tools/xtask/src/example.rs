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
    /// Four temperatures and two relays on CAN2, `examples/thermo`
    Thermo,
}

impl Example {
    /// The name of its folder.
    fn name(self) -> &'static str {
        match self {
            Self::Commissioner => "commissioner",
            Self::Io => "io",
            Self::Thermo => "thermo",
        }
    }

    /// The package of an example, or of the plain firmware.
    pub fn package(example: Option<Self>) -> String {
        example.map_or("firmware".to_owned(), |example| format!("example-{}", example.name()))
    }
}

/// The board of an example, or of the plain firmware: its crystal, and the CAN controller on the bus as in the product's
/// `pins.rs`.
pub fn board(example: Option<Example>) -> Settings {
    macro_rules! clock {
        ($product:ident) => {
            ($product::device::CRYSTAL_HZ, $product::device::CRYSTAL_IS_EXTERNAL_CLOCK)
        };
    }
    let ((hz, external_clock), controller) = match example {
        None => (clock!(firmware), 1),
        // That of an STM32F407 Discovery.
        Some(Example::Commissioner) => ((8_000_000, false), 1),
        Some(Example::Io) => (clock!(example_io), 1),
        Some(Example::Thermo) => (clock!(example_thermo), 2),
    };
    let chip_variant = ChipVariant { external_clock, ..ChipVariant::default() };
    Settings { crystal: Clock { hz, ppm: 0 }, controller, chip_variant, ..Settings::default() }
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
