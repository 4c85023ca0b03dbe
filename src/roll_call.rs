//! The roll call before each feeding of the watchdog: all tasks must have answered.

use core::sync::atomic::{AtomicBool, Ordering};

use stm32f4xx_hal::pac::Interrupt;

/// The tasks that must answer.
#[derive(Clone, Copy)]
pub enum Task {
    Received,
    Transmitted,
    Status,
    Store,
    Idle,
}

/// Whether each task has answered.
static PRESENT: [AtomicBool; 5] = [const { AtomicBool::new(false) }; 5];

/// Records that `task` is alive.
pub fn answer(task: Task) {
    PRESENT[task as usize].store(true, Ordering::Relaxed);
}

/// Whether all tasks have answered.
pub fn is_everyone_present() -> bool {
    PRESENT.iter().fold(true, |all, present| all & present.load(Ordering::Relaxed))
}

/// Begins the next roll call and triggers the tasks that do not run by themselves, by their interrupts.
pub fn begin(interrupts: [Interrupt; 4]) {
    for present in &PRESENT {
        present.store(false, Ordering::Relaxed);
    }
    interrupts.into_iter().for_each(rtic::pend);
}
