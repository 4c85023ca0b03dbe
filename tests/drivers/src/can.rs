//! The CAN driver, over a peripheral in plain memory.

#[path = "../../../stm32f4/src/can/bit_timing.rs"]
mod bit_timing;
#[path = "../../../stm32f4/src/can/controller.rs"]
mod controller;
#[path = "peripheral.rs"]
mod peripheral;
#[path = "../../../stm32f4/src/can/pins.rs"]
mod pins;
#[path = "../../../stm32f4/src/can/queue.rs"]
mod queue;

pub use controller::{Controller, Received};
pub use pins::CanPins;
