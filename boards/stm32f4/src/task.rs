//! The tasks that the watchdog waits for, and their answers.

use core::sync::atomic::{AtomicBool, Ordering};

/// The most tasks, those of the product included.
const TASKS: usize = 16;

/// Whether each task has yet to answer: none before the first roll call.
static ABSENT: [AtomicBool; TASKS] = [const { AtomicBool::new(false) }; TASKS];

/// A task that must answer.
#[derive(Clone, Copy)]
pub struct Task(usize);

impl Task {
    pub(crate) const RECEIVED: Self = Self(0);
    pub(crate) const TRANSMITTED: Self = Self(1);
    pub(crate) const STATUS: Self = Self(2);
    pub(crate) const STORE: Self = Self(3);
    /// The task that runs when no other does.
    pub const IDLE: Self = Self(4);
    pub(crate) const ALL: u16 = 0b1_1111;

    /// A task of the product, with a number from 0 to 10. [`Watchdog::expect`] makes the watchdog wait for it.
    pub const fn own(number: usize) -> Self {
        assert!(number <= 10, "the tasks of a product have the numbers 0 to 10");
        Self(5 + number)
    }

    /// Records that the task is alive.
    pub fn answer(self) {
        if let Some(absent) = ABSENT.get(self.0) {
            absent.store(false, Ordering::Relaxed);
        }
    }

    /// Its bit in the result of [`call_roll`].
    pub(crate) const fn bit(self) -> u16 {
        1 << self.0
    }
}

/// Returns a bit for each task that has not answered since the last call, and waits for all to answer again.
#[cfg(target_os = "none")]
pub(crate) fn call_roll() -> u16 {
    let mut missing = 0;
    for (number, absent) in ABSENT.iter().enumerate() {
        missing |= u16::from(absent.load(Ordering::Relaxed)) << number;
        absent.store(true, Ordering::Relaxed);
    }
    missing
}

/// Logs a reset by the watchdog, with the tasks that were silent before it, a bit for each.
#[cfg(target_os = "none")]
pub(crate) fn log_reset(silent: u16) {
    defmt::warn!("reset by the watchdog: a task did not run in time");
    if silent == 0 {
        defmt::warn!("silent: `init`, or the task of TIM2, or one of its priority or above");
        return;
    }
    let own = [
        defmt::intern!("the task of CAN RX0"),
        defmt::intern!("the task of CAN TX"),
        defmt::intern!("the task of CAN SCE"),
        defmt::intern!("the task that stores"),
        defmt::intern!("`idle`"),
    ];
    for number in (0..TASKS).filter(|number| silent >> number & 1 == 1) {
        match own.get(number) {
            Some(task) => defmt::warn!("silent: {=istr}", task),
            None => defmt::warn!("silent: Task::own({=u8})", (number - own.len()) as u8),
        }
    }
}
