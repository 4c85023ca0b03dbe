//! Keeps virtual time in step with real time, as long as the computer can keep up.

use std::time::{Duration, Instant};

use emulator::Time;

/// The lag at which the emulation stops catching up.
const PATIENCE: Duration = Duration::from_millis(500);

/// Computes the target of virtual time.
pub struct Pace {
    /// Virtual time at `since`.
    origin: Time,
    since: Instant,
    has_complained: bool,
}

impl Pace {
    /// Starts at virtual time `now`, which from here on runs with real time.
    pub fn new(now: Time) -> Self {
        Self { origin: now, since: Instant::now(), has_complained: false }
    }

    /// The virtual time to run to, given that it is `now`.
    pub fn due(&mut self, now: Time) -> Time {
        let due = self.origin + span(self.since.elapsed());
        if due.saturating_sub(now) <= span(PATIENCE) {
            return due;
        }
        if !self.has_complained {
            eprintln!("the emulation cannot keep up with real time and continues more slowly");
            self.has_complained = true;
        }
        self.origin = now;
        self.since = Instant::now();
        now
    }
}

fn span(duration: Duration) -> Time {
    Time::from_ns(duration.as_nanos() as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lost_time_is_not_caught_up() {
        let mut pace = Pace::new(Time::ZERO);
        pace.since -= Duration::from_secs(10);
        assert_eq!(pace.due(Time::from_ms(100)), Time::from_ms(100));
        let due = pace.due(Time::from_ms(100));
        assert!(due >= Time::from_ms(100) && due < Time::from_s(5));
    }

    #[test]
    fn a_short_delay_is_caught_up() {
        let mut pace = Pace::new(Time::from_s(1));
        pace.since -= Duration::from_millis(200);
        assert!(pace.due(Time::from_s(1)) >= Time::from_ms(1200));
    }
}
