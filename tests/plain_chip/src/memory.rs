//! Memory in the place of the chip's: static, and zero at first.

use std::{
    cell::UnsafeCell,
    mem::MaybeUninit,
    ops::Range,
    sync::{Mutex, MutexGuard, PoisonError},
};

use crate::pac;

/// The length of both flash sectors of the settings in bytes.
pub const SETTINGS_LEN: usize = 2 * 16 * 1024;

static SECTORS: Memory<[u32; SETTINGS_LEN / 4]> = Memory::zeroed();
/// The sectors of the settings.
pub const SETTINGS: *mut u32 = SECTORS.get().cast();

/// Erases a part of the sectors.
pub(crate) fn erase(bytes: Range<usize>) {
    // SAFETY: the callers stay within the memory, to which nobody has a reference.
    unsafe { SETTINGS.cast::<u8>().add(bytes.start).write_bytes(0xFF, bytes.len()) };
}

/// The memory of a `T` for which zeros are a valid value.
pub struct Memory<T>(UnsafeCell<MaybeUninit<T>>);

// SAFETY: `take` lets one thread at a time use the memory.
unsafe impl<T> Sync for Memory<T> {}

impl<T> Memory<T> {
    pub const fn zeroed() -> Self {
        Self(UnsafeCell::new(MaybeUninit::zeroed()))
    }

    pub const fn get(&self) -> *mut T {
        self.0.get().cast()
    }
}

/// Takes the chip as it is after a reset, with a blank flash, until the guard is dropped.
pub fn take() -> MutexGuard<'static, ()> {
    static CHIP: Mutex<()> = Mutex::new(());
    let guard = CHIP.lock().unwrap_or_else(PoisonError::into_inner);
    pac::reset();
    erase(0..SETTINGS_LEN);
    guard
}
