//! The frames that wait for the controller: the most urgent first, those of one COB-ID in the order of arrival.

use core::{cmp::Reverse, iter};

use crate::{Frame, nmt};

/// The capacity of the queue. An LSS or SDO answer wins the arbitration against the next request, so only a bus full of
/// other frames fills the queue.
const CAPACITY: usize = 16;

/// The pending frames.
#[derive(Debug)]
pub struct TransmitQueue {
    places: [Waiting; CAPACITY],
    /// The occupied places, a bit for each.
    occupied: u16,
    /// The number of frames ever queued; wraps.
    arrivals: u32,
}

#[derive(Clone, Copy, Debug)]
struct Waiting {
    frame: Frame,
    arrival: u32,
}

impl TransmitQueue {
    /// An empty queue.
    pub const fn new() -> Self {
        const NONE: Waiting = Waiting { frame: Frame::with_one_byte(0, 0), arrival: 0 };
        Self { places: [NONE; CAPACITY], occupied: 0, arrivals: 0 }
    }

    /// Whether the queue is empty.
    pub fn is_empty(&self) -> bool {
        self.occupied == 0
    }

    /// Drops all frames.
    pub fn clear(&mut self) {
        self.occupied = 0;
    }

    /// Drops the frames with these COB-IDs.
    pub fn drop_frames(&mut self, are_dropped: impl Fn(u16) -> bool) {
        let dropped = self.waiting().filter(|(_, waiting)| are_dropped(waiting.frame.cob_id()));
        self.occupied &= !dropped.fold(0, |dropped, (at, _)| dropped | bit(at));
    }

    /// Whether all waiting frames are less urgent than `frame`.
    pub fn is_behind(&self, frame: &Frame) -> bool {
        self.waiting().all(|(_, waiting)| frame.cob_id() < waiting.frame.cob_id())
    }

    /// Adds a frame; returns whether there was room. A heartbeat that is already waiting is not added again, and a PDO
    /// replaces the waiting one of the same COB-ID, so that a board that is alone on its bus does not accumulate them.
    pub fn push(&mut self, frame: Frame) -> bool {
        let cob_id = frame.cob_id();
        let is_error_control = cob_id & !0x7F == nmt::ERROR_CONTROL_COB_ID;
        let is_pdo = is_process_data(cob_id);
        let replaced = self.waiting().find(|(_, older)| {
            is_pdo && older.frame.cob_id() == cob_id || is_error_control && older.frame == frame
        });
        let at = replaced.map_or(self.occupied.trailing_ones() as usize, |(at, _)| at);
        let is_new = replaced.is_none();
        let Some(place) = self.places.get_mut(at) else {
            return false;
        };
        place.frame = frame;
        if is_new {
            self.arrivals = self.arrivals.wrapping_add(1);
            place.arrival = self.arrivals;
            self.occupied |= bit(at);
        }
        true
    }

    /// Removes the most urgent frame if `send` accepts it.
    pub fn pop_if(&mut self, send: impl FnOnce(&Frame) -> bool) {
        let now = self.arrivals;
        let urgency = |w: &Waiting| (w.frame.cob_id(), Reverse(now.wrapping_sub(w.arrival)));
        let first = self.waiting().min_by_key(|(_, waiting)| urgency(waiting));
        if let Some((at, _)) = first.filter(|(_, waiting)| send(&waiting.frame)) {
            self.occupied &= !bit(at);
        }
    }

    /// The waiting frames with their places.
    fn waiting(&self) -> impl Iterator<Item = (usize, &Waiting)> {
        let mut rest = self.occupied;
        iter::from_fn(move || {
            let at = rest.trailing_zeros() as usize;
            rest &= rest.wrapping_sub(1);
            self.places.get(at).map(|waiting| (at, waiting))
        })
    }
}

/// The bit of a place.
const fn bit(at: usize) -> u16 {
    1_u16.wrapping_shl(at as u32)
}

/// Whether only PDOs may have this COB-ID: 180h to 57Fh and 680h to 6DFh (CiA 301, 7.3.5).
fn is_process_data(cob_id: u16) -> bool {
    matches!(cob_id, 0x180..=0x57F | 0x680..=0x6DF)
}
