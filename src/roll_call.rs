//! The roll call before each feeding of the watchdog: all tasks must have answered.

use core::sync::atomic::{AtomicU8, Ordering};

use stm32f4xx_hal::pac::Interrupt;

/// The tasks that must answer.
#[derive(Clone, Copy)]
#[repr(u8)]
pub enum Task {
    Received = 1 << 0,
    Transmitted = 1 << 1,
    Status = 1 << 2,
    Store = 1 << 3,
    Idle = 1 << 4,
}

const EVERYONE: u8 = 0b1_1111;
static PRESENT: AtomicU8 = AtomicU8::new(0);

/// Records that `task` is alive.
pub fn answer(task: Task) {
    // Bound: 2 rounds: an interrupt between load and store repeats them.
    PRESENT.fetch_or(task as u8, Ordering::Relaxed);
}

/// Whether all tasks have answered.
pub fn is_everyone_present() -> bool {
    PRESENT.load(Ordering::Relaxed) == EVERYONE
}

/// Begins the next roll call and triggers the tasks that do not run by themselves.
pub fn begin() {
    PRESENT.store(0, Ordering::Relaxed);
    for interrupt in
        // Bound: 4 rounds: the interrupts in the list.
        [Interrupt::CAN1_RX0, Interrupt::CAN1_TX, Interrupt::CAN1_SCE, Interrupt::USART1]
    {
        rtic::pend(interrupt);
    }
}
