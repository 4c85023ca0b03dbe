//! The blocks of an STM32G4 that differ from those of an STM32F4 (RM0440).

mod boot;
mod pwr;
mod rcc;

pub use boot::Boot;
pub use pwr::Pwr;
pub use rcc::{AHB2ENR, APB1ENR1, APB2ENR, Rcc};
