//! STM32F4 and STM32G4 boards and a CAN bus on the host: deterministic, in virtual time, with picosecond resolution.

pub mod board;
pub mod can;
pub mod chip;
pub mod engine;
pub mod image;
pub mod network;
pub mod time;

pub use time::Time;
