//! The limit of the node's periodic services, the heartbeat and the event timers of TPDOs: one frame of them waits at a
//! time, and half of the bus is left to others.

use super::{Service, Services};
use crate::Instant;

/// The place that the periodic services share. Times that are too short for the bus would otherwise keep LSS off it,
/// whose frames have the lowest priority.
#[derive(Clone, Copy, Debug)]
pub(super) enum Periodic {
    Free,
    /// A frame waits for the bus, or is on it. It was sent to the board at this time and takes at most `micros`.
    Waiting {
        service: Service,
        since: Instant,
        micros: u32,
    },
    /// The bus is left to others for at most `micros`.
    Resting {
        until: Instant,
        micros: u32,
    },
}

impl Periodic {
    /// Records a frame that takes at most `micros`.
    pub const fn note_sent(&mut self, service: Service, micros: u32, now: Instant) {
        *self = Self::Waiting { service, since: now, micros };
    }

    /// Whether a frame waits.
    pub const fn is_waiting(&self) -> bool {
        matches!(self, Self::Waiting { .. })
    }

    /// Records that no frame of the node waits for the bus; returns whose frame has left.
    pub const fn note_none_pending(&mut self, now: Instant) -> Option<Service> {
        let Self::Waiting { service, since, micros } = *self else {
            return None;
        };
        // The board may have taken less time than the longest frame.
        let until = since.plus_micros(micros).later(now).plus_micros(micros);
        *self = Self::Resting { until, micros };
        Some(service)
    }

    /// Records that the board has dropped the frames of these services; returns whose frame was waiting.
    pub const fn frames_dropped(&mut self, services: Services) -> Option<Service> {
        match *self {
            Self::Waiting { service, .. } if services.has(service) => {
                *self = Self::Free;
                Some(service)
            }
            _ => None,
        }
    }

    /// Whether a service may send at `now`.
    pub fn is_free(&self, now: Instant) -> bool {
        self.postpone(now, now) == Some(now)
    }

    /// The time at which a service that is due at `due` may send; `None` while a frame waits.
    pub const fn postpone(&self, due: Instant, now: Instant) -> Option<Instant> {
        match *self {
            Self::Waiting { .. } => None,
            Self::Resting { until, micros } if until.is_ahead(now, micros.saturating_mul(2)) => {
                Some(until.later(due))
            }
            Self::Free | Self::Resting { .. } => Some(due),
        }
    }
}
