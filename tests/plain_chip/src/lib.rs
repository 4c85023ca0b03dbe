//! A chip in plain memory, for tests of drivers under Miri: its registers and the flash sectors of the settings. It has
//! the names that the drivers use of the HAL, `cortex-m` and `defmt`.

pub mod gpio;
pub mod memory;
pub mod pac;
pub mod rcc;

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

/// A macro of `defmt`, without a log.
#[macro_export]
macro_rules! error {
    ($text:literal $(, $value:expr)* $(,)?) => {{
        $(let _ = &$value;)*
    }};
}
pub use crate::error as warn;
