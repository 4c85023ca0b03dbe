//! The frames that wait for the controller. The most urgent one leaves first, those of one COB-ID in the order of arrival.

use core::cell::Cell;

use crate::Frame;

/// The capacity of the queue. An LSS or SDO answer wins the arbitration against the next request, so only a bus full of
/// other frames fills the queue.
const CAPACITY: usize = 16;

/// The pending frames.
#[derive(Debug)]
pub struct TransmitQueue {
    /// The pending frames, the next to leave last, then unused places.
    frames: [Frame; CAPACITY],
    /// The number of pending frames.
    len: usize,
}

impl TransmitQueue {
    /// An empty queue.
    pub const fn new() -> Self {
        Self { frames: [Frame::with_one_byte(0, 0); CAPACITY], len: 0 }
    }

    /// Whether the queue is empty.
    pub const fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Drops all frames.
    pub const fn clear(&mut self) {
        self.len = 0;
    }

    /// Drops the frames with these COB-IDs.
    pub fn drop_frames(&mut self, are_dropped: impl Fn(u16) -> bool) {
        let mut kept = 0;
        for at in 0..self.len {
            if let Some(frame) = self.frames.get(at).copied()
                && !are_dropped(frame.cob_id())
                && let Some(place) = self.frames.get_mut(kept)
            {
                *place = frame;
                kept = kept.wrapping_add(1);
            }
        }
        self.len = kept;
    }

    /// Whether frames wait, all of them less urgent than `frame`.
    pub fn is_behind(&mut self, frame: &Frame) -> bool {
        self.pending().last().is_some_and(|next| frame.cob_id() < next.cob_id())
    }

    /// Adds a frame; returns whether there was room. A PDO replaces the waiting one of the same COB-ID, so that a board
    /// that is alone on its bus does not accumulate them. The node itself lets only one heartbeat wait.
    pub fn push(&mut self, frame: Frame) -> bool {
        let cob_id = frame.cob_id();
        let pending = self.pending();
        let at = pending.iter().take_while(|behind| behind.cob_id() > cob_id).count();
        if let Some(before) = pending.get_mut(at)
            && before.cob_id() == cob_id
            && is_process_data(cob_id)
        {
            *before = frame;
            return true;
        }
        let Some(places) = self.frames.get_mut(at..=self.len) else {
            return false;
        };
        let places = Cell::from_mut(places).as_slice_of_cells();
        for (to, from) in places.iter().skip(1).zip(places).rev() {
            to.set(from.get());
        }
        places.iter().take(1).for_each(|place| place.set(frame));
        self.len = self.len.wrapping_add(1);
        true
    }

    /// Removes the most urgent frame if `send` accepts it.
    pub fn pop_if(&mut self, send: impl FnOnce(&Frame) -> bool) {
        if self.pending().last().is_some_and(send) {
            self.len = self.len.wrapping_sub(1);
        }
    }

    fn pending(&mut self) -> &mut [Frame] {
        self.frames.get_mut(..self.len).unwrap_or_default()
    }
}

/// Whether only PDOs may have this COB-ID: 180h to 57Fh and 680h to 6DFh (CiA 301, 7.3.5).
fn is_process_data(cob_id: u16) -> bool {
    matches!(cob_id, 0x180..=0x57F | 0x680..=0x6DF)
}
