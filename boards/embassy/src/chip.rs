//! The chip on its board: the file that its feature chooses.

#[cfg_attr(feature = "stm32f105", path = "chip/stm32f105.rs")]
#[cfg_attr(feature = "stm32f407", path = "chip/stm32f407.rs")]
#[cfg_attr(feature = "stm32f767", path = "chip/stm32f767.rs")]
#[cfg_attr(feature = "stm32g431", path = "chip/stm32g431.rs")]
#[cfg_attr(feature = "stm32g474", path = "chip/stm32g474.rs")]
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
