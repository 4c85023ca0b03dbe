//! The heartbeat producer 1017h: the times at which heartbeats are due.

use core::mem;

use crate::Instant;

/// The times at which heartbeats are due.
#[derive(Clone, Debug)]
pub(crate) struct HeartbeatTimes {
    /// 1017h.
    pub period_ms: u16,
    /// The next regular heartbeat.
    pub due: Instant,
    /// An additional heartbeat is due.
    pub is_extra_due: bool,
}

impl HeartbeatTimes {
    pub const fn new(period_ms: u16) -> Self {
        Self { period_ms, due: Instant::from_micros(0), is_extra_due: false }
    }

    pub const fn period_micros(&self) -> u32 {
        self.period_ms as u32 * 1000
    }

    const fn is_ahead(&self, instant: Instant, now: Instant) -> bool {
        instant.is_ahead(now, self.period_micros())
    }

    /// Records a boot-up, which replaces the additional or the regular heartbeat.
    pub fn follow_boot_up(&mut self, now: Instant) {
        if !mem::take(&mut self.is_extra_due) || !self.is_ahead(self.due, now) {
            self.due = now.plus_micros(self.period_micros());
        }
    }

    /// The time since when a heartbeat is due, if one is.
    pub fn due_since(&mut self, now: Instant) -> Option<Instant> {
        if self.period_ms == 0 {
            self.is_extra_due = false;
            return None;
        }
        if !self.is_ahead(self.due, now) {
            self.due = if self.due.has_come(now) { self.due } else { now };
            return Some(self.due);
        }
        self.is_extra_due.then_some(now)
    }

    /// Records a heartbeat.
    pub fn follow_heartbeat(&mut self, now: Instant) {
        self.is_extra_due = false;
        self.skip(now);
    }

    /// Leaves out the heartbeats until `now`.
    pub fn skip(&mut self, now: Instant) {
        if !self.is_ahead(self.due, now) {
            let period = self.period_micros();
            let next = self.due.plus_micros(period);
            // After a long delay only one heartbeat is sent, not all that were missed.
            self.due = if self.is_ahead(next, now) { next } else { now.plus_micros(period) };
        }
    }
}
