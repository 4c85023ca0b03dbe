//! The chip on its board: the features choose it.

#[cfg(feature = "stm32f407")]
mod stm32f407;

#[cfg(feature = "stm32f407")]
pub use stm32f407::*;
