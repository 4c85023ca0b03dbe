//! The CAN controller with its pins, and the frames that wait for it.

mod bit_timing;
mod controller;
#[cfg(target_os = "none")]
mod peripheral;
mod pins;
mod queue;

#[cfg(test)]
use crate::tests::peripheral;

pub use controller::{Controller, Received};
pub use peripheral::Peripheral;
pub use pins::{CanPins, Receives, Transmits};
