//! Memory in the place of the chip's: static, and zero at first.

use std::{
    cell::UnsafeCell,
    mem::MaybeUninit,
    sync::{Mutex, MutexGuard, PoisonError},
};

use crate::{board, pac};

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
    board::erase(0..board::SETTINGS_LEN);
    guard
}
