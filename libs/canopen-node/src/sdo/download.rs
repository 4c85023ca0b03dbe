//! The data of a download, and segmented download (CiA 301, 7.2.4.3.3 and 7.2.4.3.4).

use lss_slave::bytes::copy;

use super::{Abort, Message, Objects, upload::TOGGLE};
use crate::object_dictionary::Entry;

/// A download under way. A domain goes to the application part by part; every other value is assembled in the
/// server's buffer and written at the end, so that a transfer that is cut short changes nothing.
#[derive(Clone, Copy, Debug)]
pub(super) struct Download {
    pub entry: &'static Entry,
    /// The number of bytes that the client has announced.
    announced: Option<u32>,
    len: u32,
    toggle: u8,
}

impl Download {
    pub fn begin<O: Objects>(
        entry: &'static Entry,
        announced: Option<u32>,
        objects: &mut O,
        buffer: &[u8],
    ) -> Result<Self, Abort> {
        let (shortest, longest) = match (entry.options.is_streamed(), entry.data_type.size()) {
            (true, _) => (0, u32::MAX),
            (false, 0) => (0, buffer.len() as u32),
            (false, size) => (size.into(), size.into()),
        };
        match announced {
            Some(len) if len > longest => Err(Abort::TooLong),
            Some(len) if len < shortest => Err(Abort::TooShort),
            _ => Ok(()),
        }?;
        if entry.options.is_streamed() {
            objects.begin_domain(entry, announced)?;
        }
        Ok(Self { entry, announced, len: 0, toggle: 0 })
    }

    /// Accepts the next bytes.
    pub fn add<O: Objects>(
        &mut self,
        bytes: &[u8],
        objects: &mut O,
        buffer: &mut [u8],
    ) -> Result<(), Abort> {
        let len = self.len.checked_add(bytes.len() as u32).ok_or(Abort::Memory)?;
        if self.announced.is_some_and(|announced| len > announced) {
            return Err(Abort::TooLong);
        }
        if self.entry.options.is_streamed() {
            objects.write_domain(self.entry, self.len, bytes)?;
        } else {
            let place = buffer.get_mut(self.len as usize..len as usize).ok_or(Abort::TooLong)?;
            copy(bytes, 0, place);
        }
        self.len = len;
        Ok(())
    }

    /// The number of bytes that the announced length still lacks.
    fn missing(&self) -> usize {
        self.announced.map_or(usize::MAX, |announced| announced.saturating_sub(self.len) as usize)
    }

    /// Writes the object; returns the confirmation, unless it follows later.
    pub fn end<O: Objects>(
        &self,
        confirmation: Message,
        objects: &mut O,
        buffer: &[u8],
    ) -> Result<Option<Message>, Abort> {
        if self.announced.is_some_and(|announced| self.len < announced) {
            return Err(Abort::TooShort);
        }
        if self.entry.options.is_streamed() {
            return objects.end_domain(self.entry, self.len, confirmation);
        }
        let value = buffer.get(..self.len as usize).unwrap_or_default();
        objects.write(self.entry, value, confirmation)
    }

    /// Handles a segment; returns the answer, if there is one now, and whether it was the last segment.
    pub fn handle_segment<O: Objects>(
        &mut self,
        command: u8,
        data: &[u8; 7],
        objects: &mut O,
        buffer: &mut [u8],
    ) -> Result<(Option<Message>, bool), Abort> {
        const LAST: u8 = 0x01;
        let toggle = command & TOGGLE;
        if toggle != self.toggle {
            return Err(Abort::Toggle);
        }
        let is_last = command & LAST != 0;
        let unused = match usize::from(command >> 1 & 7) {
            // The segment does not say how many bytes count (CiA 301, 7.2.4.3.4): the announced length does.
            0 if is_last => data.len().saturating_sub(self.missing()),
            unused => unused,
        };
        self.add(without_last(data, unused), objects, buffer)?;
        self.toggle ^= TOGGLE;
        let answer = Message::segment(0x20 | toggle, [0; 7]);
        let answer = if is_last { self.end(answer, objects, buffer)? } else { Some(answer) };
        Ok((answer, is_last))
    }
}

/// The bytes of `data` but the last `unused`.
pub(super) fn without_last(data: &[u8; 7], unused: usize) -> &[u8] {
    data.get(..data.len().saturating_sub(unused)).unwrap_or_default()
}
