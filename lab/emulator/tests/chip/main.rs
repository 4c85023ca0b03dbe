//! The chip's registers as seen by a program, without a CPU.

mod adc;
mod bxcan;
mod clocks;
mod controllers;
mod fdcan;
mod flash;
mod g4;
mod pwm;
mod rig;
mod spi;
mod start_up;
mod timer;
mod unmodelled;
