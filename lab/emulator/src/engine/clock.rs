//! Conversion between core clock cycles and time, exact across every change of the clock.

use crate::{
    Time,
    can::{Clock, timing::SCALE},
};

/// A clock and one known point on it. All other points follow from it, so errors do not accumulate.
#[derive(Clone, Copy, Debug)]
pub struct CycleClock {
    clock: Clock,
    cycles: u64,
    time: Time,
}

impl CycleClock {
    /// A clock that runs at `clock` and has counted `cycles` at `time`.
    pub const fn new(clock: Clock, cycles: u64, time: Time) -> Self {
        Self { clock, cycles, time }
    }

    pub const fn clock(&self) -> Clock {
        self.clock
    }

    /// The time at the start of cycle `cycles`, rounded down to the picosecond.
    pub fn time_at(&self, cycles: u64) -> Time {
        let elapsed = u128::from(cycles - self.cycles) * SCALE / self.clock.rate();
        self.time + Time::from_ps(elapsed as u64)
    }

    /// The first cycle that starts at `time` or later.
    pub fn cycle_at(&self, time: Time) -> u64 {
        let elapsed = u128::from(time.saturating_sub(self.time).as_ps()) * self.clock.rate();
        self.cycles.saturating_add(u64::try_from(elapsed.div_ceil(SCALE)).unwrap_or(u64::MAX))
    }

    /// Changes the frequency from cycle `cycles` on.
    pub fn change(&mut self, clock: Clock, cycles: u64) {
        *self = Self::new(clock, cycles, self.time_at(cycles));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cycle_starts_no_earlier_than_the_time_it_was_asked_for() {
        let clock = CycleClock::new(Clock { hz: 127_999_999, ppm: -37 }, 5, Time::from_ps(7));
        for ps in (7..3_000_000).step_by(997) {
            let time = Time::from_ps(ps);
            let cycle = clock.cycle_at(time);
            assert!(clock.time_at(cycle) >= time, "{ps}");
            assert!(cycle == 5 || clock.time_at(cycle - 1) < time, "{ps}");
        }
    }

    #[test]
    fn a_day_at_128_mhz_has_exactly_its_cycles() {
        let clock = CycleClock::new(Clock { hz: 128_000_000, ppm: 0 }, 0, Time::ZERO);
        assert_eq!(clock.cycle_at(Time::from_s(86_400)), 86_400 * 128_000_000);
        assert_eq!(clock.time_at(86_400 * 128_000_000), Time::from_s(86_400));
    }

    #[test]
    fn a_change_of_clock_starts_where_the_old_one_stood() {
        let mut clock = CycleClock::new(Clock { hz: 16_000_000, ppm: 0 }, 0, Time::ZERO);
        clock.change(Clock { hz: 128_000_000, ppm: 0 }, 16_000);
        assert_eq!(clock.time_at(16_000), Time::from_ms(1));
        assert_eq!(clock.time_at(16_000 + 128_000), Time::from_ms(2));
    }
}
