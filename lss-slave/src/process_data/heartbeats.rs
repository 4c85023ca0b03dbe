//! The heartbeat consumer (CiA 301, 7.2.8.3.2): 1016h.

use core::mem;

use crate::{Frame, Instant, NodeId, application::Event, nmt, sdo::Abort};

/// Error code of a heartbeat that is missing (CiA 301, table 26).
pub(crate) const LOST: u16 = 0x8130;

/// An entry of 1016h.
#[derive(Clone, Copy, Debug)]
pub(super) struct Producer {
    node: u8,
    time_ms: u16,
}

/// The knowledge of the node of an entry.
#[derive(Clone, Copy, Debug)]
pub(super) enum Watch {
    /// Nothing was received yet.
    Waiting,
    Alive {
        until: Instant,
    },
    Lost,
}

impl Watch {
    /// Handles a frame, which may be the producer's heartbeat. A boot-up is the first one (CiA 301, 7.2.8.2.2.2).
    pub fn handle(&mut self, producer: &Producer, frame: &Frame, now: Instant) -> Option<Event> {
        let &[state] = frame.data() else {
            return None;
        };
        let node = producer.node()?;
        if producer.cob_id() != Some(frame.cob_id()) {
            return None;
        }
        *self = producer.is_at(now);
        (state == nmt::State::Initialisation as u8).then_some(Event::BootUp(node))
    }

    /// Whether the heartbeat begins to be missing at `now`.
    pub fn poll(&mut self, now: Instant) -> bool {
        let is_missing = self.poll_at().is_some_and(|at| at.has_come(now));
        if is_missing {
            *self = Self::Lost;
        }
        is_missing
    }

    /// The time at which a heartbeat is missing.
    pub const fn poll_at(&self) -> Option<Instant> {
        match *self {
            Self::Alive { until } => Some(until),
            Self::Waiting | Self::Lost => None,
        }
    }

    /// Grants a new period.
    pub const fn restart(&mut self, producer: &Producer, now: Instant) {
        if let Self::Alive { .. } = self {
            *self = producer.is_at(now);
        }
    }

    pub const fn is_lost(&self) -> bool {
        matches!(self, Self::Lost)
    }
}

impl Producer {
    pub const UNUSED: Self = Self { node: 0, time_ms: 0 };

    /// The node that is watched. An entry without a time or with another node-ID is not used.
    pub fn node(&self) -> Option<NodeId> {
        NodeId::new(self.node).filter(|_| self.time_ms != 0)
    }

    /// The COB-ID of the heartbeat, if one is expected.
    pub fn cob_id(&self) -> Option<u16> {
        self.node().map(|node| nmt::ERROR_CONTROL_COB_ID + u16::from(node.get()))
    }

    const fn is_at(&self, now: Instant) -> Watch {
        Watch::Alive { until: now.plus_micros(self.time_ms as u32 * 1000) }
    }

    /// The value of the entry.
    pub fn value(&self) -> u32 {
        u32::from(self.node) << 16 | u32::from(self.time_ms)
    }

    /// Sets the entry with number `at`.
    ///
    /// # Errors
    /// [`Abort::Incompatible`] if another entry watches the same node, [`Abort::InvalidValue`] for a reserved bit.
    pub fn set(producers: &mut [Self], at: usize, value: u32) -> Result<(), Abort> {
        if value >> 24 != 0 {
            return Err(Abort::InvalidValue);
        }
        let wanted = Self { node: (value >> 16) as u8, time_ms: value as u16 };
        let place = producers.get_mut(at).ok_or(Abort::NoSubIndex)?;
        let before = mem::replace(place, wanted);
        let mut same = producers.iter().filter(|other| other.node() == wanted.node());
        if wanted.node().is_some() && same.nth(1).is_some() {
            if let Some(place) = producers.get_mut(at) {
                *place = before;
            }
            return Err(Abort::Incompatible);
        }
        Ok(())
    }
}
