//! Controller Area Network, bit by bit: frames, protocol controllers, the wire, and the STM32's bxCAN and FDCAN.

pub mod adapter;
pub mod bus;
pub mod bxcan;
pub mod controller;
pub mod fault;
pub mod fdcan;
pub mod frame;
pub mod peripheral;
mod requests;
mod stream;
pub mod timing;
mod wire;

pub use adapter::Adapter;
pub use bus::{Bus, Station};
pub use bxcan::Bxcan;
pub use controller::{Controller, ErrorKind, Event, Pins, Transmit};
pub use fdcan::Fdcan;
pub use frame::{Frame, Id};
pub use peripheral::{Can, Note, Peripheral};
pub use stream::Level;
pub use timing::{BitSegments, Clock, Mode};
pub use wire::{Noise, Short};
