//! Time: a free-running count of microseconds, and an interrupt at the next deadline.

use canopen_node::Instant;
use cortex_m::peripheral::NVIC;
use stm32f4xx_hal::{
    pac::{Interrupt, TIM2},
    rcc::{Enable, Rcc},
};

use crate::chip::APB1_HZ;

/// Clock periods per microsecond: if an APB is slower than the core, its timers run at twice its clock (RM0090, 7.2).
const PERIODS: u32 = 2 * APB1_HZ / 1_000_000;

/// The interrupt of the [`Alarm`].
const INTERRUPT: Interrupt = Interrupt::TIM2;

/// A timer interrupt at an instant: TIM2, which counts all 32 bits.
pub struct Alarm {
    timer: TIM2,
}

impl Alarm {
    /// Starts the count at 0.
    pub fn new(timer: TIM2, rcc: &mut Rcc) -> Self {
        TIM2::enable(rcc);
        timer.psc().write(|w| w.psc().set((PERIODS - 1) as u16));
        // The prescaler takes effect only with an update event (RM0090, 18.3.1).
        timer.egr().write(|w| w.ug().set_bit());
        timer.dier().write(|w| w.cc1ie().set_bit());
        timer.cr1().write(|w| w.cen().set_bit());
        Self { timer }
    }

    /// Sets the interrupt to `instant`, or triggers it at once if that has passed; replaces an earlier instant, and
    /// acknowledges its interrupt.
    pub fn set(&mut self, instant: Instant) {
        self.timer.ccr1().write(|w| w.ccr().set(instant.as_micros()));
        self.timer.sr().write(|w| w.cc1if().clear_bit());
        // The count may have passed the instant before.
        if instant.has_come(now()) {
            NVIC::pend(INTERRUPT);
        }
    }

    /// Sleeps until `instant`, or until another interrupt has come, for a program without interrupt handlers. They are
    /// disabled from the first call on: what comes before a sleep ends it at once.
    pub fn sleep_until(&mut self, instant: Instant, other: Interrupt) {
        cortex_m::interrupt::disable();
        // SAFETY: no handler runs.
        unsafe {
            NVIC::unmask(INTERRUPT);
            NVIC::unmask(other);
        }
        self.set(instant);
        cortex_m::asm::wfi();
        NVIC::unpend(INTERRUPT);
        NVIC::unpend(other);
    }
}

/// The present time.
pub fn now() -> Instant {
    // SAFETY: reading the count has no effect.
    Instant::from_micros(unsafe { (*TIM2::ptr()).cnt().read().bits() })
}
