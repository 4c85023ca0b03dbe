//! The chip's registers as seen by a program, without a CPU.

mod adc;
mod bxcan;
mod clocks;
mod controllers;
mod flash;
mod rig;
mod start_up;
mod timer;
