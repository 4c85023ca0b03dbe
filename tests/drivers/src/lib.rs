//! The drivers of the firmware on a computer, for Miri: their registers and the flash are plain memory.
//!
//! The sources are those of the firmware. Only what they name is replaced: the HAL, the parts of `cortex-m`, `rtic` and
//! `defmt` that they use, and the two modules that know a fixed address or a controller.

extern crate self as cortex_m;
extern crate self as defmt;
extern crate self as rtic;
extern crate self as stm32f4xx_hal;

pub mod board;
pub mod controller;
pub mod gpio;
pub mod memory;
pub mod pac;
pub mod rcc;

#[path = "../../../src/bit_timing.rs"]
mod bit_timing;
#[path = "../../../src/can.rs"]
pub mod can;
#[path = "../../../src/can_pins.rs"]
pub mod can_pins;
#[path = "../../../src/clock.rs"]
pub mod clock;
#[path = "../../../src/crystal.rs"]
pub mod crystal;
#[path = "../../../src/flash.rs"]
pub mod flash;
#[path = "../../../src/supply.rs"]
pub mod supply;
#[path = "../../../src/transmit_queue.rs"]
mod transmit_queue;

use lss_slave_firmware as product;

/// The part of `src/runner.rs` that the flash driver uses.
mod runner {
    pub const PARAMETERS: usize = crate::product::Node::PARAMETERS;
}

/// The part of `cortex-m`.
pub mod peripheral {
    pub struct SCB;

    impl SCB {
        /// # Panics
        /// Always: no test goes on after a reset.
        pub fn sys_reset() -> ! {
            panic!("the firmware resets the chip")
        }
    }
}

/// The part of `rtic`: the interrupts that drivers trigger have no handlers.
pub fn pend(_: pac::Interrupt) {}

/// The macros of `defmt`, without a log.
macro_rules! log {
    ($text:literal $(, $value:expr)* $(,)?) => {{
        $(let _ = &$value;)*
    }};
}
pub(crate) use {log as error, log as warn};
