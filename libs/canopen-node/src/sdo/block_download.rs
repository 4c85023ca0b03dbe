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
    /// The client has segments to send without waiting for an answer: not after the last one of all.
    is_in_block: bool,
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
        (Self { download, crc, is_in_block: true, last: 0, held: None }, answer)
    }

    /// Whether the client may send segments without waiting for an answer. Then every message is a segment, whatever its
    /// first byte; only an abort is not.
    pub const fn is_in_block(&self) -> bool {
        self.is_in_block
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
        // Segments count from 1: 80h would be the last segment with number 0, and is an abort.
        let number = command & !LAST;
        if number == 0 {
            return Err(Abort::SequenceNumber);
        }
        let size = match O::PROGRAM_DOWNLOAD {
            true => objects.granted(self.download.entry),
            false => BLOCK_SIZE,
        };
        let is_last = ends_block(command, size);
        self.is_in_block = !is_last;
        let is_in_sequence = number == self.last.wrapping_add(1);
        if is_in_sequence {
            // The segment before was not the last of all, so all of its bytes count.
            self.release(0, objects, buffer)?;
            self.held = Some(data);
            self.last = number;
        }
        if !is_last {
            return Ok(None);
        }
        let next = match O::PROGRAM_DOWNLOAD {
            true => objects.grant(self.download.entry),
            false => BLOCK_SIZE,
        };
        let answer = Message::segment(0xA2, [self.last, next, 0, 0, 0, 0, 0]);
        // The last segment of all may come after a lost one: then the client repeats both in the next block.
        let is_complete = is_in_sequence && command & LAST != 0;
        (self.is_in_block, self.last) = (!is_complete, 0);
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

/// Whether the segment with this first byte is the last in a block of this size.
pub(super) const fn ends_block(command: u8, size: u8) -> bool {
    command & !LAST == size || command > LAST
}
