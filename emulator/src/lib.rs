//! STM32F4 boards and a CAN bus on the computer: deterministic, in virtual time, to the picosecond.

pub mod can;
pub mod time;

pub use time::Time;
