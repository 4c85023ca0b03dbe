//! The drivers of the firmware on a computer, for Miri: their registers and the flash are plain memory.
//!
//! The sources are those of the firmware. Only what they name is replaced: the HAL, the parts of `cortex-m` and
//! `defmt` that they use, and the two modules that know a fixed address or a controller.

extern crate self as cortex_m;
extern crate self as defmt;
extern crate self as stm32f4xx_hal;

pub mod board;
pub mod can;
pub mod gpio;
pub mod memory;
pub mod pac;
pub mod rcc;

#[path = "../../../stm32f4/src/clock.rs"]
pub mod clock;
#[path = "../../../stm32f4/src/crystal.rs"]
pub mod crystal;
#[path = "../../../stm32f4/src/flash.rs"]
pub mod flash;
#[path = "../../../stm32f4/src/supply.rs"]
pub mod supply;

use canopen_stm32f4::chip;

/// The part of `cortex-m`.
pub mod peripheral {
    use crate::pac::Interrupt;

    pub struct NVIC;

    impl NVIC {
        /// The interrupts that drivers trigger have no handlers.
        pub fn pend(_: Interrupt) {}
    }

    pub struct SCB;

    impl SCB {
        /// # Panics
        /// Always: no test goes on after a reset.
        pub fn sys_reset() -> ! {
            panic!("the firmware resets the chip")
        }
    }
}

/// The macros of `defmt`, without a log.
macro_rules! log {
    ($text:literal $(, $value:expr)* $(,)?) => {{
        $(let _ = &$value;)*
    }};
}
pub(crate) use {log as error, log as warn};
