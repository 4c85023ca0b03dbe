//! What the node asks of an SDO server, and the server of the node.

use core::fmt::Debug;

use super::{Abort, confirm};
use crate::{
    Instant,
    object_dictionary::{Entry, Object},
};

/// The value of an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Value {
    Number(u32),
    Text(&'static str),
}

/// The effect of a write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Written {
    Now,
    /// The answer follows later: [`Service::confirm`] or [`abort`](super::abort).
    Later,
}

/// The object dictionary behind the server.
pub trait Objects {
    /// The time after which an unfinished transfer ends, in microseconds.
    const TIMEOUT_MICROS: u32;

    fn find(&self, index: u16, sub_index: u8) -> Result<&'static Entry, Abort>;
    /// The value of an object of the node.
    fn read(&self, object: Object) -> Result<Value, Abort>;
    /// Writes an object of the node.
    fn write(&mut self, entry: &Entry, value: u32) -> Result<Written, Abort>;

    /// The length of any value but a text of the node, in bytes.
    fn len(&self, entry: &Entry) -> Result<u32, Abort>;
    /// Copies a part of such a value; returns the number of bytes.
    fn read_part(&self, entry: &Entry, offset: u32, to: &mut [u8]) -> usize;
    /// Writes any object but a domain.
    fn write_bytes(&mut self, entry: &Entry, bytes: &[u8]) -> Result<Written, Abort>;
    fn write_domain(&mut self, entry: &Entry, offset: u32, bytes: &[u8]) -> Result<(), Abort>;
    fn end_domain(&mut self, entry: &Entry, len: u32) -> Result<(), Abort>;
    fn abort_domain(&mut self, entry: &Entry);
}

/// An SDO server. It holds one request and at most one transfer, which the next initiate ends.
pub trait Service: Clone + Debug {
    /// A server without a request.
    const NEW: Self;

    /// Discards the request and the current transfer without an answer to the client.
    fn reset(&mut self);

    /// Accepts a request, which [`poll`](Self::poll) answers.
    fn handle(&mut self, request: [u8; 8]);

    /// Executes the request and returns the answer, if there is one now. Without an answer returns the next message of
    /// the transfer.
    fn poll<O: Objects>(&mut self, objects: &mut O, now: Instant) -> Option<[u8; 8]>;

    /// The latest time of the next [`poll`](Self::poll), if there is no request before.
    fn poll_at<O: Objects>(&self) -> Option<Instant> {
        None
    }

    /// Discards the current transfer, if it needs the client in time, without an answer.
    fn end_transfer(&mut self) {}

    /// The domain that the current transfer writes.
    fn domain(&self) -> Option<&'static Entry> {
        None
    }

    /// Whether a block of an upload has further segments.
    fn is_sending_block(&self) -> bool {
        false
    }

    /// Records that no frame of the node waits for the bus.
    fn note_sent(&mut self) {}

    /// The answer to the download whose store has succeeded.
    fn confirm(&self, index: u16, sub_index: u8) -> [u8; 8] {
        confirm(index, sub_index)
    }
}
