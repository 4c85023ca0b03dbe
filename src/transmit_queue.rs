//! The frames that wait for a mailbox: the most urgent first, those of one COB-ID in the order of arrival.

use core::cmp::Reverse;

use lss_slave::{Frame, nmt};

use crate::product::Node;

/// The capacity of the queue. An LSS or SDO answer wins the arbitration against the next request, so only a bus full of
/// other frames fills the queue.
const CAPACITY: usize = 16;

/// The pending frames.
pub struct TransmitQueue {
    places: [Option<Waiting>; CAPACITY],
    len: usize,
    /// The number of frames ever queued; wraps.
    arrivals: u32,
}

struct Waiting {
    frame: Frame,
    arrival: u32,
}

impl TransmitQueue {
    /// An empty queue.
    pub const fn new() -> Self {
        Self { places: [const { None }; CAPACITY], len: 0, arrivals: 0 }
    }

    /// Whether the queue is empty.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Drops all frames.
    pub fn clear(&mut self) {
        *self = Self::new();
    }

    /// Drops all frames except those of `cob_id`.
    pub fn retain(&mut self, cob_id: u16) {
        if self.is_empty() {
            return;
        }
        for place in &mut self.places {
            if place.as_ref().is_some_and(|waiting| waiting.frame.cob_id() != cob_id) {
                *place = None;
                self.len = self.len.saturating_sub(1);
            }
        }
    }

    /// Adds a frame; returns whether there was room. A heartbeat that is already waiting is not added again, and a PDO
    /// replaces the waiting one of the same COB-ID, so that a board that is alone on its bus does not accumulate them.
    pub fn push(&mut self, frame: Frame) -> bool {
        let is_error_control = frame.cob_id() & !0x7F == nmt::ERROR_CONTROL_COB_ID;
        if is_error_control && self.places.iter().flatten().any(|waiting| waiting.frame == frame) {
            return true;
        }
        if Node::HAS_TPDOS && is_process_data(frame.cob_id()) {
            let mut waiting = self.places.iter_mut().flatten();
            if let Some(older) = waiting.find(|older| older.frame.cob_id() == frame.cob_id()) {
                older.frame = frame;
                return true;
            }
        }
        let Some(place) = self.places.iter_mut().find(|place| place.is_none()) else {
            return false;
        };
        self.arrivals = self.arrivals.wrapping_add(1);
        *place = Some(Waiting { frame, arrival: self.arrivals });
        self.len = self.len.saturating_add(1);
        true
    }

    /// Removes the most urgent frame if `send` accepts it; returns whether it did.
    pub fn pop_if(&mut self, send: impl FnOnce(&Frame) -> bool) -> bool {
        let now = self.arrivals;
        let urgency = |w: &Waiting| (w.frame.cob_id(), Reverse(now.wrapping_sub(w.arrival)));
        let waiting = self.places.iter_mut().filter(|place| place.is_some());
        let Some(place) = waiting.min_by_key(|place| place.as_ref().map(urgency)) else {
            return false;
        };
        let is_sent = place.as_ref().is_some_and(|waiting| send(&waiting.frame));
        if is_sent {
            *place = None;
            self.len = self.len.saturating_sub(1);
        }
        is_sent
    }
}

/// Whether only PDOs may have this COB-ID: 180h to 57Fh and 680h to 6DFh (CiA 301, 7.3.5).
fn is_process_data(cob_id: u16) -> bool {
    matches!(cob_id, 0x180..=0x57F | 0x680..=0x6DF)
}
