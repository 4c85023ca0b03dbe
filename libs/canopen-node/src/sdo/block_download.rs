//! SDO block download (CiA 301, 7.2.4.3.9 to 7.2.4.3.11).

use super::{
    Abort, Address, Message, Objects,
    crc::Crc,
    download::{Download, without_last},
};

/// The number of segments in a block: the most, as each is handled when it arrives.
pub const BLOCK_SIZE: u8 = 127;
/// The bit of the last segment of all.
const LAST: u8 = 0x80;

/// A block download under way.
#[derive(Clone, Copy, Debug)]
pub(super) struct BlockDownload {
    pub download: Download,
    crc: Option<Crc>,
    /// What the client has yet to send of the block; `None` after the last segment of all.
    rest: Option<Rest>,
    /// The number of the last segment of the block in sequence.
    last: u8,
    /// The last segment in sequence. It is held back until the next one shows that all of its bytes count.
    held: Option<[u8; 7]>,
}

impl BlockDownload {
    /// A block download whose client checks data by CRC or not, and the answer to it, with the size of the first block.
    pub fn begin(download: Download, has_crc: bool, size: u8) -> (Self, Message) {
        const CRC_SUPPORTED: u8 = 0x04;
        let address = Address::of(download.entry);
        let answer = Message::new(0xA0 | CRC_SUPPORTED, address, size as u32);
        let crc = has_crc.then(Crc::default);
        (Self { download, crc, rest: Some(Rest::WHOLE), last: 0, held: None }, answer)
    }

    /// The segments that the client may send without waiting for an answer. As long as there are some, every message is
    /// a segment, whatever its first byte; only an abort is not.
    pub const fn rest(&self) -> Option<Rest> {
        self.rest
    }

    /// Handles a segment; returns the confirmation after the last one of a block.
    ///
    /// After a lost segment the rest of the block is ignored, and the client repeats it.
    pub fn handle_segment<O: Objects>(
        &mut self,
        command: u8,
        data: [u8; 7],
        objects: &mut O,
        buffer: &mut [u8],
    ) -> Result<Option<Message>, Abort> {
        let number = command & !LAST;
        if number == 0 {
            return Err(Abort::SequenceNumber);
        }
        let size = match O::PROGRAM_DOWNLOAD {
            true => objects.granted(self.download.entry),
            false => BLOCK_SIZE,
        };
        self.rest = self.rest.and_then(|rest| rest.after(command, size));
        let is_in_sequence = number == self.last.wrapping_add(1);
        if is_in_sequence {
            self.release(0, objects, buffer)?;
            self.held = Some(data);
            self.last = number;
        }
        if self.rest.is_some() {
            return Ok(None);
        }
        let next = match O::PROGRAM_DOWNLOAD {
            true => objects.grant(self.download.entry),
            false => BLOCK_SIZE,
        };
        let answer = Message::segment(0xA2, [self.last, next, 0, 0, 0, 0, 0]);
        let is_complete = is_in_sequence && command & LAST != 0;
        (self.rest, self.last) = ((!is_complete).then_some(Rest::WHOLE), 0);
        Ok(Some(answer))
    }

    /// Handles the end of the transfer; returns the answer, if there is one now.
    pub fn end<O: Objects>(
        &mut self,
        command: u8,
        [c0, c1, ..]: [u8; 7],
        objects: &mut O,
        buffer: &mut [u8],
    ) -> Result<Option<Message>, Abort> {
        self.release((command >> 2 & 7).into(), objects, buffer)?;
        if self.crc.is_some_and(|crc| crc.value() != u16::from_le_bytes([c0, c1])) {
            return Err(Abort::Crc);
        }
        self.download.end(Message::segment(0xA1, [0; 7]), objects, buffer)
    }

    /// Adds the segment that is held back, without its unused bytes, to the data.
    fn release<O: Objects>(
        &mut self,
        unused: usize,
        objects: &mut O,
        buffer: &mut [u8],
    ) -> Result<(), Abort> {
        let Some(held) = self.held.take() else {
            return Ok(());
        };
        let bytes = without_last(&held, unused);
        if let Some(crc) = &mut self.crc {
            crc.add(bytes);
        }
        self.download.add(bytes, objects, buffer)
    }
}

/// The segments of a block that follow the one with this number.
///
/// A client sends a block without waiting, so they arrive even if the transfer has ended within the block, and must not
/// be executed as requests. CiA 301 gives them nothing that a request cannot have: only the sequence number in the first
/// byte tells them apart. So the next number in sequence is a segment. Another first byte is a request if it begins a
/// transfer, as a client that has ended a transfer may begin another at once, and a segment behind a lost one if it does
/// not. One ambiguity remains: at one of 127 positions a first request looks like the next segment. We ignore it; the
/// client will repeat it. File content that is executed does more harm.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Rest(u8);

impl Rest {
    const WHOLE: Self = Self(0);

    /// Whether a message is one of the segments, if the transfer has ended.
    pub const fn contains(self, command: u8, begins_transfer: bool) -> bool {
        !begins_transfer || command & !LAST == self.0.wrapping_add(1)
    }

    /// The segments after the one with this first byte, if there are any in a block of this size.
    pub const fn after(self, command: u8, size: u8) -> Option<Self> {
        match command & !LAST {
            0 => Some(self),
            number if number == size || command & LAST != 0 => None,
            number => Some(Self(number)),
        }
    }
}
