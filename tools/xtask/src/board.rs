//! The boards that one can buy, whose pins, LEDs and clock are in this repository.

use canopen_stm32f4::chip::Chip;

/// A board with the name that its maker gives it.
#[derive(Clone, Copy, clap::ValueEnum)]
pub enum Board {
    Stm32f407gDisc1,
    NucleoF446re,
    Stm32H405,
    /// With the port to embassy-stm32
    NucleoG431rb,
}

impl Board {
    /// The features with which its program is built. One that is not that of a chip has the clock and the LEDs.
    pub const fn features(self) -> &'static str {
        match self {
            Self::Stm32f407gDisc1 => "stm32f407",
            Self::NucleoF446re => "nucleo-f446re",
            Self::Stm32H405 => "stm32-h405",
            Self::NucleoG431rb => "stm32g431",
        }
    }

    /// The chip, in the words of probe-rs.
    pub fn probe_rs(self) -> &'static str {
        let chip = match self {
            Self::Stm32f407gDisc1 => "stm32f407",
            Self::NucleoF446re => "stm32f446",
            Self::Stm32H405 => "stm32f405",
            Self::NucleoG431rb => return "STM32G431RB",
        };
        Chip::named(chip).expect("a chip of boards/stm32f4").probe_rs
    }
}
