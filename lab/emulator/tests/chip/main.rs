//! The chip's registers as seen by a program, without a CPU.

mod adc;
mod bxcan;
mod clocks;
mod controllers;
mod crc;
mod fdcan;
mod flash;
mod g4;
mod rig;
mod start_up;
mod timer;
mod unmodelled;
