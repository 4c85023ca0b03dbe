//! An STM32F4 board for a CANopen node with LSS: clocks, CAN controller, settings in flash, and the calls that a
//! product's tasks make. On a computer there are only the [chips](chip), and for tests the drivers,
//! over a chip in plain memory.

#![no_std]
// The tests use the drivers without the runner and the board, which call the rest of them.
#![cfg_attr(test, allow(dead_code))]

#[cfg(test)]
extern crate plain_chip as cortex_m;
#[cfg(test)]
extern crate plain_chip as defmt;
#[cfg(test)]
extern crate plain_chip as stm32f4xx_hal;

pub mod chip;

#[cfg(target_os = "none")]
pub mod board;
#[cfg(any(target_os = "none", test))]
pub mod can;
#[cfg(any(target_os = "none", test))]
mod clock;
#[cfg(any(target_os = "none", test))]
mod crystal;
#[cfg(target_os = "none")]
mod fault;
#[cfg(any(target_os = "none", test))]
mod flash;
#[cfg(target_os = "none")]
mod led;
#[cfg(target_os = "none")]
mod log;
#[cfg(all(target_os = "none", feature = "update"))]
mod mailbox;
#[cfg(target_os = "none")]
pub mod master;
#[cfg(target_os = "none")]
mod runner;
#[cfg(target_os = "none")]
mod start;
#[cfg(any(target_os = "none", test))]
mod supply;
#[cfg(any(target_os = "none", test))]
mod task;
#[cfg(test)]
mod tests;
#[cfg(feature = "update")]
pub mod update;
#[cfg(target_os = "none")]
pub mod watchdog;

#[cfg(target_os = "none")]
pub use crate::{
    board::Board,
    clock::now,
    crystal::Crystal,
    led::{Indicators, Led},
    runner::{Runner, Storage},
    watchdog::Watchdog,
};
#[cfg(test)]
use tests::start;
