//! The CAN controller with its pins.

mod bit_timing;
mod controller;
mod peripheral;
mod pins;

pub use controller::Controller;
pub use peripheral::Peripheral;
pub use pins::{CanPins, CanRx, CanTx};
