//! An STM32F4 board for a CANopen node with LSS: clocks, CAN controller, settings in flash, and the calls that a
//! product's tasks make. On a computer there are only the [chips](chip).

#![no_std]

pub mod chip;

#[cfg(target_os = "none")]
pub mod board;
#[cfg(target_os = "none")]
pub mod can;
#[cfg(target_os = "none")]
mod clock;
#[cfg(target_os = "none")]
mod crystal;
#[cfg(target_os = "none")]
mod fault;
#[cfg(target_os = "none")]
mod flash;
#[cfg(target_os = "none")]
mod led;
#[cfg(target_os = "none")]
mod log;
#[cfg(all(target_os = "none", feature = "update"))]
mod mailbox;
#[cfg(target_os = "none")]
mod memory;
#[cfg(target_os = "none")]
mod panic;
#[cfg(target_os = "none")]
mod pll;
#[cfg(target_os = "none")]
#[doc(hidden)]
pub mod reset;
#[cfg(target_os = "none")]
mod runner;
#[cfg(target_os = "none")]
mod start;
#[cfg(target_os = "none")]
mod supply;
#[cfg(target_os = "none")]
mod task;
#[cfg(feature = "update")]
pub mod update;
#[cfg(target_os = "none")]
pub mod watchdog;

/// The exceptions of a product. They have the names that cortex-m-rt calls, unless the feature `handlers` is off.
#[cfg(target_os = "none")]
pub mod handlers {
    pub use crate::{crystal::NonMaskableInt, fault::HardFault, start::__pre_init};
}

#[cfg(target_os = "none")]
pub use crate::{
    board::Board,
    clock::{Alarm, now},
    crystal::Crystal,
    flash::SettingsFlash,
    led::{Indicators, Led},
    runner::{Runner, Storage},
    watchdog::Watchdog,
};
