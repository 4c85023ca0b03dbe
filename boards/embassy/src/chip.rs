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

/// Lets the watchdog and the timer of embassy's clock stand still while a debugger halts the core.
pub fn freeze_in_a_halt() {
    use embassy_stm32::pac::DBGMCU;
    #[cfg(feature = "stm32f105")]
    DBGMCU.cr().modify(|w| {
        w.set_iwdg(true);
        w.set_tim4(true);
    });
    #[cfg(any(feature = "stm32f407", feature = "stm32f767"))]
    DBGMCU.apb1fzr().modify(|w| {
        w.set_iwdg(true);
        w.set_tim12(true);
    });
    #[cfg(any(feature = "stm32g431", feature = "stm32g474"))]
    DBGMCU.apb1lfzr().modify(|w| w.set_iwdg(true));
    #[cfg(feature = "stm32l476")]
    DBGMCU.apb1fzr1().modify(|w| w.set_iwdg(true));
    #[cfg(any(feature = "stm32g431", feature = "stm32g474", feature = "stm32l476"))]
    DBGMCU.apb2fzr().modify(|w| w.set_tim15(true));
    #[cfg(feature = "stm32h743")]
    {
        DBGMCU.apb4fzr1().modify(|w| w.set_iwdg1(true));
        DBGMCU.apb1lfzr1().modify(|w| w.set_tim12(true));
    }
}

/// A double word whose programming a power cut has interrupted has a double error: the log finds that it is not valid. Any
/// other cause ends in a reset.
// SAFETY: it only clears the flags.
#[cfg(any(feature = "stm32g431", feature = "stm32g474", feature = "stm32l476"))]
#[cortex_m_rt::exception]
unsafe fn NonMaskableInt() {
    /// ECCD, and ECCD2 of an STM32G4 whose flash is one bank of 128 bits.
    const DOUBLE_ERRORS: u32 = 1 << 31 | 1 << 29;
    let found = embassy_stm32::pac::FLASH.eccr().read();
    if found.0 & DOUBLE_ERRORS == 0 {
        cortex_m::peripheral::SCB::sys_reset();
    }
    embassy_stm32::pac::FLASH.eccr().write_value(found);
}
