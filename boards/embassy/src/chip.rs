//! The chip on its board: the file of its family, which its feature chooses.
//!
//! Another chip of embassy-stm32 with CAN1 or FDCAN1 comes in four steps:
//!
//! 1. `chip/` gets a file: a copy of the nearest, with pins, crystal and LEDs of the board. A chip of a family that is
//!    there gets only its lines. The compiler finds what has another name: interrupts (`TIM16_FDCAN_IT0` on an
//!    STM32G0), registers, the bank.
//! 2. It does not find two things there. `clear_double_error` clears ECCD if the flash has an error-correcting code, in
//!    both registers of an STM32G0B1. `freeze_in_a_halt` of an STM32G0 first gives DBGMCU a clock: DBGEN in RCC_APBENR1.
//! 3. A line below names that file. A file `.x` beside the others, named as the feature, has the memory but the settings.
//! 4. The feature, in `Cargo.toml`, begins with `stm32`. It has the controller, the chip, a timer for embassy's clock, and
//!    `single-bank` or `dual-bank` if embassy-stm32 asks for one. The timer is not TIM2, which is the node's, and does
//!    not share an interrupt with the controller, as TIM16 and TIM17 of an STM32G0 do.
//!
//! The flash drivers of embassy-stm32 0.6.0, and the way round:
//!
//! - On an STM32F4 it programs words, for a supply of at least 2.7 V, and does not reset the data cache of a chip with
//!   one bank. That cache is off by default, and stays so. On an STM32L4 the port switches it off.
//! - On an STM32G0, G4 and L4 a double word whose programming was interrupted raises an NMI when it is read. The handler
//!   clears the flag, and resets the chip for any other cause.
//! - On an STM32H7 it is a bus fault. The port reads with FAULTMASK and BFHFNMIGN set.

#[cfg_attr(feature = "stm32f105", path = "chip/stm32f105.rs")]
#[cfg_attr(any(feature = "stm32f407", feature = "stm32f767"), path = "chip/stm32f4_f7.rs")]
#[cfg_attr(any(feature = "stm32g431", feature = "stm32g474"), path = "chip/stm32g4.rs")]
#[cfg_attr(feature = "stm32h743", path = "chip/stm32h743.rs")]
#[cfg_attr(feature = "stm32l476", path = "chip/stm32l476.rs")]
mod chosen;

pub use chosen::*;

/// A unit of the flash whose programming a power cut has interrupted has a double error: the log finds that it is not
/// valid. Any other cause ends in a reset.
// SAFETY: it only clears the flag.
#[cortex_m_rt::exception]
unsafe fn NonMaskableInt() {
    if !clear_double_error() {
        cortex_m::peripheral::SCB::sys_reset();
    }
}
