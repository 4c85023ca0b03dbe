//! Controller Area Network, bit by bit: frames, protocol controllers, the wire, and the STM32's bxCAN.

pub mod adapter;
pub mod bus;
pub mod bxcan;
pub mod controller;
pub mod fault;
pub mod frame;
mod stream;
pub mod timing;
mod wire;

pub use adapter::Adapter;
pub use bus::{Bus, Station};
pub use bxcan::Bxcan;
pub use controller::{Controller, ErrorKind, Event, Pins};
pub use frame::{Frame, Id};
pub use stream::Level;
pub use timing::{BitSegments, Clock, Mode};
pub use wire::{Noise, Short};
