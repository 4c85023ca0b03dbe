//! Time: the monotonic of the tasks, and the microseconds that the node is told.

use cortex_m::peripheral::SYST;
use lss_slave::Instant;
use rtic_monotonics::systick::prelude::*;

use crate::device::SYSCLK_HZ;

systick_monotonic!(Mono, 1_000);
const MICROS_PER_TICK: u32 = 1_000;

/// Starts the monotonic; the core runs at [`SYSCLK_HZ`].
pub fn start(systick: SYST) {
    Mono::start(systick, SYSCLK_HZ);
}

/// The present time, finer than the monotonic's ticks: a switch delay begins with a request, not with a tick.
pub fn now() -> Instant {
    const CYCLES_PER_MICRO: u32 = SYSCLK_HZ / 1_000_000;
    const CYCLES_PER_TICK: u32 = MICROS_PER_TICK * CYCLES_PER_MICRO;
    let read = || (Mono::now().as_ticks() as u32, CYCLES_PER_TICK - 1 - SYST::get_current());
    let (tick, mut cycles) = read();
    let (tick_after, cycles_after) = read();
    // A tick between the two halves of the first reading?
    if tick_after != tick {
        cycles = cycles_after;
    }
    let micros = tick_after.wrapping_mul(MICROS_PER_TICK);
    Instant::from_micros(micros.wrapping_add(cycles / CYCLES_PER_MICRO))
}

/// Waits for `event`, but only until the tick before or after `deadline`, if there is one: the caller looks, and waits for
/// the next if it was the one before.
pub async fn wait(event: impl Future<Output = ()>, deadline: Option<Instant>) {
    let Some(deadline) = deadline else {
        return event.await;
    };
    let ticks = deadline.micros_after(now()).div_ceil(MICROS_PER_TICK);
    let _ = Mono::timeout_at(Mono::now() + u64::from(ticks).millis(), event).await;
}
