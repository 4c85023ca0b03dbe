//! The object dictionary and the memory behind the SDO server.

use core::fmt::Debug;

use super::{Abort, Message};
use crate::object_dictionary::Entry;

/// The value of an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Content {
    /// A number of the node, of up to four bytes.
    Number(u32),
    Text(&'static str),
    /// The application has it, in this field.
    OfApplication(u8),
}

/// When a download that was not refused is answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum Answer {
    /// At once: it is done.
    Now,
    /// When its outcome is known.
    Later,
}

/// The object dictionary behind the server.
pub(crate) trait Objects {
    /// The time after which an unfinished transfer ends, in microseconds.
    const TIMEOUT_MICROS: u32;
    /// Whether there are the objects of program download.
    const PROGRAM_DOWNLOAD: bool;
    /// Whether a client can read, and write, so much that block transfer pays. Otherwise the server takes no code for it.
    const BLOCK_UPLOAD: bool;
    const BLOCK_DOWNLOAD: bool;

    fn find(&self, index: u16, sub_index: u8) -> Result<&'static Entry, Abort>;
    fn read(&mut self, entry: &Entry) -> Result<Content, Abort>;
    /// Writes any object but a domain. Returns the `confirmation`, or `None` if it follows [later](Answer::Later).
    fn write(
        &mut self,
        entry: &Entry,
        bytes: &[u8],
        confirmation: Message,
    ) -> Result<Option<Message>, Abort>;
    /// Withdraws the confirmation that would follow a store.
    fn forget_store(&mut self);

    /// The length of a value of the application, in bytes.
    fn len(&mut self, entry: &Entry, field: u8) -> Result<u32, Abort>;
    /// Copies a part of a value of the application; returns the number of bytes.
    fn read_part(&self, entry: &Entry, field: u8, offset: u32, to: &mut [u8]) -> usize;
    fn begin_domain(&mut self, entry: &Entry, announced: Option<u32>) -> Result<(), Abort>;
    fn write_domain(&mut self, entry: &Entry, offset: u32, bytes: &[u8]) -> Result<(), Abort>;
    /// Ends the download of a domain, as [`write`](Self::write) does.
    fn end_domain(
        &mut self,
        entry: &Entry,
        len: u32,
        confirmation: Message,
    ) -> Result<Option<Message>, Abort>;
    fn abort_domain(&mut self, entry: &Entry);
    /// The number of segments that the client may send next of a program, and that it was told before.
    fn grant(&mut self, entry: &Entry) -> u8;
    fn granted(&mut self, entry: &Entry) -> u8;
}

/// The memory of the SDO server for the value under way, with room for the longest that a client can write: an array of
/// bytes.
pub trait Buffer: AsRef<[u8]> + AsMut<[u8]> + Clone + Debug {
    /// A buffer that holds nothing.
    const EMPTY: Self;
}

impl<const N: usize> Buffer for [u8; N] {
    const EMPTY: Self = [0; N];
}
