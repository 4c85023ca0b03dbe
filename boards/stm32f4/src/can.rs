//! The CAN controller with its pins.

mod bit_timing;
mod controller;
#[cfg(target_os = "none")]
mod peripheral;
mod pins;

#[cfg(test)]
use crate::tests::peripheral;

pub use controller::Controller;
pub use peripheral::Peripheral;
pub use pins::{CanPins, Receives, Transmits};
