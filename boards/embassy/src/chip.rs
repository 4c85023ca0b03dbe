//! The chip on its board: the features choose it.

#[cfg(feature = "stm32f105")]
mod stm32f105;
#[cfg(feature = "stm32f407")]
mod stm32f407;
#[cfg(feature = "stm32f767")]
mod stm32f767;
#[cfg(feature = "stm32g431")]
mod stm32g431;
#[cfg(feature = "stm32g474")]
mod stm32g474;
#[cfg(feature = "stm32h743")]
mod stm32h743;
#[cfg(feature = "stm32l476")]
mod stm32l476;

#[cfg(feature = "stm32f105")]
pub use stm32f105::*;
#[cfg(feature = "stm32f407")]
pub use stm32f407::*;
#[cfg(feature = "stm32f767")]
pub use stm32f767::*;
#[cfg(feature = "stm32g431")]
pub use stm32g431::*;
#[cfg(feature = "stm32g474")]
pub use stm32g474::*;
#[cfg(feature = "stm32h743")]
pub use stm32h743::*;
#[cfg(feature = "stm32l476")]
pub use stm32l476::*;

#[cfg(not(feature = "stm32h743"))]
pub use embassy_stm32::peripherals::IWDG as Watchdog;
#[cfg(feature = "stm32h743")]
pub use embassy_stm32::peripherals::IWDG1 as Watchdog;

/// A double word whose programming a power cut has interrupted has a double error: the log finds that it is not valid.
// SAFETY: it only clears the flag.
#[cfg(any(feature = "stm32g431", feature = "stm32g474", feature = "stm32l476"))]
#[cortex_m_rt::exception]
unsafe fn NonMaskableInt() {
    embassy_stm32::pac::FLASH.eccr().modify(|w| w.set_eccd(true));
}
