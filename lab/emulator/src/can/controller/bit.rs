//! The times of a controller's actions: bit boundaries, sample points, and the edges that move them.

use super::{Controller, Decoder, Event, Phase};
use crate::{Time, can::Level};

impl Controller {
    /// The time of its next change of level or sample; `Time::MAX` if only an edge can cause one.
    pub(in crate::can) fn next_action(&self) -> Time {
        let bit = match self.phase {
            _ if self.next != self.driven => self.start,
            Phase::Stopped | Phase::BusOff => Time::MAX,
            Phase::Idle if !self.synchronised => self.idle_sample(),
            _ => self.start + self.spans.sample,
        };
        bit.min(self.line.next_action())
    }

    /// On an idle bus a controller needs only those samples that are to be inverted.
    fn idle_sample(&self) -> Time {
        let Some(flip) = self.line.next_flip() else { return Time::MAX };
        let first = self.start + self.spans.sample;
        let late = flip.max(self.now).saturating_sub(first).as_ps();
        first + self.spans.bit * late.div_ceil(self.spans.bit.as_ps())
    }

    /// Whether its action at `now` is a change of the level that it drives.
    pub(in crate::can) fn drives_at(&self, now: Time) -> bool {
        self.next != self.driven && self.start <= now || self.line.next_action() <= now
    }

    /// Reports the time and the level of the wire between actions.
    pub(crate) fn settle(&mut self, now: Time, wire: Level) {
        self.now = now.max(self.now);
        self.wire = self.heard(wire);
    }

    /// Checks the wire after a change of the wire or of the controller's line.
    pub(in crate::can) fn resume(&mut self, now: Time, wire: Level) {
        if wire == Level::Dominant && self.wire == Level::Recessive && !self.is_stopped() {
            self.falling_edge(now);
        }
    }

    /// Acts at a bit boundary, or where its pins change.
    pub(in crate::can) fn drive(&mut self, now: Time) {
        self.now = now;
        self.line.act(now);
        let is_bit = self.next != self.driven && self.start <= now;
        if is_bit {
            self.driven = self.next;
        }
        self.follow_line(now);
        if !is_bit {
            return;
        }
        if self.phase == Phase::Idle && self.driven == Level::Dominant {
            self.frame_start = now;
            self.decoder = Decoder::default();
            self.phase = Phase::Frame;
            self.begin_transmission(0);
        }
    }

    /// Synchronises on a recessive to dominant edge of the wire, in steps of its own quanta: hard between frames,
    /// otherwise by at most the jump width.
    pub(in crate::can) fn falling_edge(&mut self, now: Time) {
        if !self.hears_wire() {
            return;
        }
        if self.is_stopped() && self.watching {
            self.events.push_back(Event::Activity);
        }
        if self.synchronised || self.sampled == Level::Dominant || self.mode.loopback {
            return;
        }
        let quantum = self.spans.quantum as i64;
        let late = (now.as_ps() as i64 - self.start.as_ps() as i64).div_euclid(quantum);
        let quanta = if self.phase.synchronises_hard() {
            self.next = Level::Recessive;
            late
        } else {
            late.clamp(-self.spans.jump_width, self.spans.jump_width)
        };
        self.start = Time::from_ps((self.start.as_ps() as i64 + quanta * quantum) as u64);
        self.synchronised = true;
    }

    /// On an idle bus, schedules the offered frame for the next bit boundary.
    pub(super) fn schedule(&mut self) {
        self.next = Level::Recessive;
        let Some((from, _)) = self.offered.filter(|_| self.may_transmit()) else { return };
        let from = from.max(self.now);
        let bit = self.spans.bit.as_ps();
        let bits = from.saturating_sub(self.start).as_ps().div_ceil(bit);
        self.start += self.spans.bit * bits;
        self.next = Level::Dominant;
    }
}
