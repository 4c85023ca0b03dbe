//! The data of an upload, and segmented upload (CiA 301, 7.2.4.3.5 and 7.2.4.3.6).

use lss_slave::bytes::copy;

use super::{Abort, Address, Content, Message, Objects};
use crate::object_dictionary::Entry;

/// The toggle bit of a segment.
pub(super) const TOGGLE: u8 = 0x10;

/// An upload under way.
#[derive(Clone, Copy, Debug)]
pub(super) struct Upload {
    pub address: Address,
    source: Source,
    /// The first byte that has not been sent.
    pub offset: u32,
    toggle: u8,
}

/// The place of the data.
#[derive(Clone, Copy, Debug)]
enum Source {
    Text(&'static str),
    /// The first bytes of the server's buffer: a copy of the value as it was at the beginning.
    Buffer(u32),
    /// The field of the application, with this length: a domain, or a constant longer than every value that can be written.
    Object(&'static Entry, u8, u32),
}

impl Upload {
    /// Begins the upload of this value of an object. A value that may change is copied to `buffer`, so that the client
    /// gets the bytes of one moment. Only a domain is read while it is sent: its application decides.
    pub fn begin<O: Objects>(
        entry: &'static Entry,
        value: Content,
        objects: &mut O,
        buffer: &mut [u8],
    ) -> Result<Self, Abort> {
        let source = match value {
            Content::Text(text) => Source::Text(text),
            Content::Number(number) => {
                copy(&number.to_le_bytes(), 0, buffer);
                Source::Buffer(entry.data_type.size().into())
            }
            Content::OfApplication(field) => {
                let len = objects.len(entry, field)?;
                match buffer.get_mut(..len as usize) {
                    Some(copy) if !entry.options.is_streamed() => {
                        objects.read_part(entry, field, 0, copy);
                        Source::Buffer(len)
                    }
                    _ => Source::Object(entry, field, len),
                }
            }
        };
        Ok(Self::new(entry, source))
    }

    const fn new(entry: &Entry, source: Source) -> Self {
        Self { address: Address::of(entry), source, offset: 0, toggle: 0 }
    }

    /// The number of bytes.
    pub const fn len(&self) -> u32 {
        match self.source {
            Source::Text(text) => text.len() as u32,
            Source::Buffer(len) | Source::Object(.., len) => len,
        }
    }

    /// Copies the bytes from `offset` to `to`, as many as there are; returns their number.
    pub fn read<O: Objects>(
        &self,
        objects: &O,
        buffer: &[u8],
        to: &mut [u8],
    ) -> Result<usize, Abort> {
        let rest = self.len().saturating_sub(self.offset) as usize;
        let len = rest.min(to.len());
        let to = to.get_mut(..len).unwrap_or_default();
        let offset = self.offset as usize;
        let copied = match self.source {
            Source::Text(text) => copy(text.as_bytes(), offset, to),
            Source::Buffer(_) => copy(buffer, offset, to),
            Source::Object(entry, field, _) => objects.read_part(entry, field, self.offset, to),
        };
        // The domain has become shorter.
        if copied < len { Err(Abort::NoData) } else { Ok(len) }
    }

    /// Whether all bytes have been sent.
    pub const fn is_complete(&self) -> bool {
        self.offset >= self.len()
    }

    /// The next segment, in answer to a request with this toggle bit.
    pub fn next_segment<O: Objects>(
        &mut self,
        toggle: u8,
        objects: &O,
        buffer: &[u8],
    ) -> Result<Message, Abort> {
        if toggle != self.toggle {
            return Err(Abort::Toggle);
        }
        let mut data = [0; 7];
        let len = self.read(objects, buffer, &mut data)?;
        self.offset = self.offset.saturating_add(len as u32);
        self.toggle ^= TOGGLE;
        let unused = 7_u8.saturating_sub(len as u8);
        Ok(Message::segment(toggle | unused << 1 | u8::from(self.is_complete()), data))
    }
}
