//! What the drivers use of [`board`](crate::board), where the flash is plain memory and nothing changes meanwhile.

pub use stm32f4xx_hal::memory::SETTINGS;

pub const SYSCLK_HZ: u32 = crate::chip::sysclk_hz(&crate::chip::CHIP);

/// Without the wait.
pub fn comes_in_100_ms(it_is_there: impl Fn() -> bool) -> bool {
    it_is_there()
}
