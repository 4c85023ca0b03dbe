//! Time: a tick each millisecond, and the microseconds that the node is told.

use core::sync::atomic::{AtomicU32, Ordering};

use cortex_m::peripheral::{SCB, SYST, syst::SystClkSource};
use lss_slave::Instant;

use crate::device::SYSCLK_HZ;

const MICROS_PER_TICK: u32 = 1_000;
const CYCLES_PER_MICRO: u32 = SYSCLK_HZ / 1_000_000;
const CYCLES_PER_TICK: u32 = MICROS_PER_TICK * CYCLES_PER_MICRO;

static TICKS: AtomicU32 = AtomicU32::new(0);

/// Starts the ticks; the core runs at [`SYSCLK_HZ`].
pub fn start(mut systick: SYST) {
    systick.set_clock_source(SystClkSource::Core);
    systick.set_reload(CYCLES_PER_TICK - 1);
    systick.clear_current();
    systick.enable_interrupt();
    systick.enable_counter();
}

/// Counts a tick, in its interrupt.
pub fn tick() {
    TICKS.store(TICKS.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
}

/// The present time, finer than the ticks: a switch delay begins with a request, not with a tick. To be called where no
/// tick interrupts.
#[inline(never)] // Ten callers, and 60 bytes.
pub fn now() -> Instant {
    let mut ticks = TICKS.load(Ordering::Relaxed);
    let mut cycles_left = SYST::get_current();
    if SCB::is_pendst_pending() {
        // Between the two readings, or before: then the first shows the cycles of an earlier tick.
        ticks = ticks.wrapping_add(1);
        cycles_left = SYST::get_current();
    }
    let micros = ticks.wrapping_mul(MICROS_PER_TICK);
    Instant::from_micros(
        micros.wrapping_add(CYCLES_PER_TICK.wrapping_sub(cycles_left) / CYCLES_PER_MICRO),
    )
}

/// A span that passes again and again.
pub struct Interval {
    ms: u32,
    began: u32,
}

impl Interval {
    /// One of `ms` milliseconds, which begins now.
    pub fn of_ms(ms: u32) -> Self {
        Self { ms, began: TICKS.load(Ordering::Relaxed) }
    }

    /// Whether it has passed; then the next one has begun.
    pub fn has_passed(&mut self) -> bool {
        let has_passed = TICKS.load(Ordering::Relaxed).wrapping_sub(self.began) >= self.ms;
        if has_passed {
            self.began = self.began.wrapping_add(self.ms);
        }
        has_passed
    }
}
