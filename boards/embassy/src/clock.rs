//! Time: a count of microseconds by TIM2, which goes on while a debugger halts the core. That of embassy stands still.

use canopen_node::{Instant, runner::System};
use embassy_stm32::{Peri, peripherals::TIM2, time::Hertz, timer::low_level::Timer};

/// The count, and the core.
pub struct Clock(Timer<'static, TIM2>);

impl Clock {
    pub fn new(timer: Peri<'static, TIM2>) -> Self {
        let mut timer = Timer::new(timer);
        timer.set_tick_freq(Hertz::mhz(1));
        timer.start();
        Self(timer)
    }

    /// Waits until `at`; returns at once if that has passed.
    pub async fn wait_until(&self, at: Instant) {
        embassy_time::Timer::after_micros(at.micros_after(self.now()).into()).await;
    }
}

impl System for Clock {
    #[cfg(not(feature = "stm32f105"))]
    fn now(&self) -> Instant {
        Instant::from_micros(self.0.regs_gp32().cnt().read())
    }

    /// The chip has no timer of 32 bits, so that the node does not notice a halt.
    #[cfg(feature = "stm32f105")]
    fn now(&self) -> Instant {
        Instant::from_micros(embassy_time::Instant::now().as_micros() as u32)
    }

    fn reset(&mut self) {
        cortex_m::peripheral::SCB::sys_reset();
    }
}
