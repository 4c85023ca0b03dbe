//! The heartbeat consumer (CiA 301, 7.2.8.3.2): 1016h.

use core::mem;

use crate::{Frame, Instant, NodeId, application::Event, nmt, sdo::Abort};

/// Error code of a heartbeat that is missing (CiA 301, table 26).
pub(crate) const LOST: u16 = 0x8130;

/// An entry of 1016h, and what is known of its node.
#[derive(Clone, Copy, Debug)]
pub(super) struct Producer {
    node: u8,
    time_ms: u16,
    watch: Watch,
}

#[derive(Clone, Copy, Debug)]
enum Watch {
    /// Nothing was received yet.
    Waiting,
    Alive {
        until: Instant,
    },
    Lost,
}

impl Producer {
    pub const UNUSED: Self = Self { node: 0, time_ms: 0, watch: Watch::Waiting };

    /// The node that is watched. An entry without a time or with another node-ID is not used.
    fn node(&self) -> Option<NodeId> {
        NodeId::new(self.node).filter(|_| self.time_ms != 0)
    }

    /// The COB-ID of the heartbeat, if one is expected.
    pub fn cob_id(&self) -> Option<u16> {
        self.node().map(|node| nmt::ERROR_CONTROL_COB_ID + u16::from(node.get()))
    }

    const fn is_at(&self, now: Instant) -> Watch {
        Watch::Alive { until: now.plus_micros(self.time_ms as u32 * 1000) }
    }

    /// Handles a frame, which may be the node's heartbeat. A boot-up is the first one (CiA 301, 7.2.8.2.2.2).
    pub fn handle(&mut self, frame: &Frame, now: Instant) -> Option<Event> {
        let node = self.node()?;
        let &[state] = frame.data() else {
            return None;
        };
        if self.cob_id() != Some(frame.cob_id()) {
            return None;
        }
        self.watch = self.is_at(now);
        (state == nmt::State::Initialisation as u8).then_some(Event::BootUp(node))
    }

    /// The node, when its heartbeat is missing.
    pub fn poll(&mut self, now: Instant) -> Option<NodeId> {
        if !self.poll_at()?.has_come(now) {
            return None;
        }
        self.watch = Watch::Lost;
        self.node()
    }

    /// The time at which a heartbeat is missing.
    pub fn poll_at(&self) -> Option<Instant> {
        match self.watch {
            Watch::Alive { until } => Some(until),
            Watch::Waiting | Watch::Lost => None,
        }
    }

    /// Forgets the heartbeats received until now.
    pub const fn forget(&mut self) {
        self.watch = Watch::Waiting;
    }

    /// Grants a new period.
    pub fn restart(&mut self, now: Instant) {
        if let Watch::Alive { .. } = self.watch {
            self.watch = self.is_at(now);
        }
    }

    pub const fn is_lost(&self) -> bool {
        matches!(self.watch, Watch::Lost)
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
        let wanted = Self { node: (value >> 16) as u8, time_ms: value as u16, ..Self::UNUSED };
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
