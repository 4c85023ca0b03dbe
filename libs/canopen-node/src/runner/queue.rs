//! The frames that wait for the controller. The most urgent one leaves first, those of one COB-ID in the order of arrival.

use core::cell::Cell;

use crate::{Frame, Service, Services};

/// The most TPDOs that wait: each at its latest value.
const TPDOS: usize = 16;
/// Boot-up, emergency message and heartbeat, of which the node has one wait.
const MESSAGES: usize = 3;
/// The most answers of LSS and SDO that wait. They win the arbitration against the next request, so these are the answers
/// to what a controller has received at a time: three frames in bxCAN, five in others.
const ANSWERS: usize = 5;
const CAPACITY: usize = TPDOS + MESSAGES + ANSWERS;

/// The pending frames.
#[derive(Debug)]
pub struct TransmitQueue {
    /// The pending frames with their services, the next to leave last, then unused places.
    frames: [(Frame, Service); CAPACITY],
    /// The number of pending frames.
    len: usize,
}

impl TransmitQueue {
    /// An empty queue.
    pub const fn new() -> Self {
        Self { frames: [(Frame::with_one_byte(0, 0), Service::Lss); CAPACITY], len: 0 }
    }

    /// Whether the queue is empty.
    pub const fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Drops all frames.
    pub const fn clear(&mut self) {
        self.len = 0;
    }

    /// Drops the frames of these services.
    pub fn drop_frames(&mut self, services: Services) {
        let pending = Cell::from_mut(self.pending()).as_slice_of_cells();
        let kept = pending.iter().filter(|place| !services.has(place.get().1));
        self.len = pending.iter().zip(kept).map(|(to, from)| to.set(from.get())).count();
    }

    /// Whether frames wait, all of them less urgent than `frame`.
    pub fn is_behind(&mut self, frame: &Frame) -> bool {
        self.pending().last().is_some_and(|(next, _)| frame.cob_id() < next.cob_id())
    }

    /// Adds a frame; returns whether there was room. A TPDO replaces the waiting one of the same COB-ID, so that a board
    /// that is alone on its bus does not accumulate them. The node itself lets only one heartbeat wait.
    pub fn push(&mut self, frame: Frame, service: Service) -> bool {
        let frame = (frame, service);
        let mut older = self.pending().iter_mut().filter(|_| service == Service::Tpdo);
        if let Some(older) = older.find(|older| rank(older) == rank(&frame)) {
            *older = frame;
            return true;
        }
        let Some(place) = self.frames.get_mut(self.len) else {
            return false;
        };
        *place = frame;
        self.len = self.len.wrapping_add(1);
        let pending = Cell::from_mut(self.pending()).as_slice_of_cells();
        for (behind, place) in pending.iter().zip(pending.iter().skip(1)).rev() {
            let other = behind.get();
            if rank(&other) > rank(&frame) {
                break;
            }
            place.set(other);
            behind.set(frame);
        }
        true
    }

    /// Removes the most urgent frame if `send` accepts it.
    pub fn pop_if(&mut self, send: impl FnOnce(&(Frame, Service)) -> bool) {
        if self.pending().last().is_some_and(send) {
            self.len = self.len.wrapping_sub(1);
        }
    }

    fn pending(&mut self) -> &mut [(Frame, Service)] {
        self.frames.get_mut(..self.len).unwrap_or_default()
    }
}

/// The order in which frames leave: by COB-ID, but the TPDOs last, since a master waits for the others.
const fn rank((frame, service): &(Frame, Service)) -> u16 {
    match service {
        Service::Tpdo => 0x800 | frame.cob_id(),
        _ => frame.cob_id(),
    }
}
