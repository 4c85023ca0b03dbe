//! The roll call before each feeding of the watchdog: only if every task has answered, all of them are alive.

use core::sync::atomic::{AtomicU8, Ordering};

/// Who has to answer.
#[derive(Clone, Copy)]
#[repr(u8)]
pub enum Task {
    Received = 1 << 0,
    Transmitted = 1 << 1,
    Status = 1 << 2,
    Deadlines = 1 << 3,
    Idle = 1 << 4,
}

const EVERYONE: u8 = 0b1_1111;
static PRESENT: AtomicU8 = AtomicU8::new(0);

/// `task` is alive.
pub fn answer(task: Task) {
    PRESENT.fetch_or(task as u8, Ordering::Relaxed);
}

/// Ends one roll call and begins the next: whether everyone has answered.
pub fn is_everyone_present() -> bool {
    PRESENT.swap(0, Ordering::Relaxed) == EVERYONE
}
