//! The flash sectors of the settings, and the wait of `stm32f4/src/board.rs`.

use std::ops::Range;

use crate::memory::Memory;

/// The core clock.
pub(crate) const SYSCLK_HZ: u32 = crate::chip::sysclk_hz(&crate::chip::CHIP);
/// The length of both sectors in bytes.
pub const SETTINGS_LEN: usize = 2 * 16 * 1024;

static MEMORY: Memory<[u32; SETTINGS_LEN / 4]> = Memory::zeroed();
/// Sectors 1 and 2.
pub const SETTINGS: *mut u32 = MEMORY.get().cast();

/// Erases a part of the sectors.
pub fn erase(bytes: Range<usize>) {
    // SAFETY: the callers stay within the memory, to which nobody has a reference.
    unsafe { SETTINGS.cast::<u8>().add(bytes.start).write_bytes(0xFF, bytes.len()) };
}

/// Without the wait: nothing changes meanwhile.
pub fn comes_in_100_ms(it_is_there: impl Fn() -> bool) -> bool {
    it_is_there()
}
