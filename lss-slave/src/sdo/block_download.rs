//! SDO block download (CiA 301, 7.2.4.3.9 to 7.2.4.3.11).

use super::{
    Abort, Objects, Written,
    crc::Crc,
    download::{Download, without_last},
    segment,
};

/// The number of segments in a block: the most, as each is handled when it arrives.
const BLOCK_SIZE: u8 = 127;

/// A block download under way.
#[derive(Clone, Copy, Debug)]
pub(super) struct BlockDownload {
    pub download: Download,
    crc: Option<Crc>,
    phase: Phase,
    /// The last segment in sequence. It is held back until the next one shows that all of its bytes count.
    held: Option<[u8; 7]>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// A block is being received.
    Receiving {
        /// The sequence number of the last segment in sequence.
        last: u8,
        /// A segment of the block has arrived, whether in sequence or not.
        has_begun: bool,
    },
    /// All segments have been received, the end has not been confirmed.
    Ending,
}

const NEW_BLOCK: Phase = Phase::Receiving { last: 0, has_begun: false };

impl BlockDownload {
    /// A block download whose client checks data by CRC or not, and the answer to it.
    pub fn begin(download: Download, has_crc: bool) -> (Self, [u8; 8]) {
        const CRC_SUPPORTED: u8 = 0x04;
        let answer =
            super::Address::of(download.entry).message(0xA0 | CRC_SUPPORTED, BLOCK_SIZE.into());
        let crc = has_crc.then(Crc::default);
        (Self { download, crc, phase: NEW_BLOCK, held: None }, answer)
    }

    /// Whether the next message is a segment, whatever its first byte; only an abort is not.
    pub fn is_receiving(&self) -> bool {
        self.phase != Phase::Ending
    }

    /// Whether the client may wait for a confirmation, because the last segment of its block was lost.
    pub fn is_within_block(&self) -> bool {
        matches!(self.phase, Phase::Receiving { has_begun: true, .. })
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
    ) -> Result<Option<[u8; 8]>, Abort> {
        const LAST: u8 = 0x80;
        let Phase::Receiving { mut last, .. } = self.phase else {
            return Err(Abort::Command);
        };
        let (number, is_last) = (command & !LAST, command & LAST != 0);
        if number == 0 || number > BLOCK_SIZE {
            return Err(Abort::SequenceNumber);
        }
        let is_in_sequence = number == last.wrapping_add(1);
        if is_in_sequence {
            self.release(0, objects, buffer)?;
            self.held = Some(data);
            last = number;
        }
        self.phase = Phase::Receiving { last, has_begun: true };
        if !is_last && number < BLOCK_SIZE {
            return Ok(None);
        }
        let answer = self.confirm_block();
        if is_last && is_in_sequence {
            self.phase = Phase::Ending;
        }
        Ok(Some(answer))
    }

    /// Confirms the segments in sequence and expects the next block.
    pub fn confirm_block(&mut self) -> [u8; 8] {
        let last = match self.phase {
            Phase::Receiving { last, .. } => last,
            Phase::Ending => 0,
        };
        self.phase = NEW_BLOCK;
        segment(0xA2, [last, BLOCK_SIZE, 0, 0, 0, 0, 0])
    }

    /// Handles the end of the transfer; returns the answer and what the write has done.
    pub fn end<O: Objects>(
        &mut self,
        command: u8,
        [c0, c1, ..]: [u8; 7],
        objects: &mut O,
        buffer: &mut [u8],
    ) -> Result<([u8; 8], Written), Abort> {
        const END: u8 = 0x01;
        if self.is_receiving() || command & END == 0 {
            return Err(Abort::Command);
        }
        self.release((command >> 2 & 7).into(), objects, buffer)?;
        if self.crc.is_some_and(|crc| crc.value() != u16::from_le_bytes([c0, c1])) {
            return Err(Abort::Crc);
        }
        let written = self.download.end(objects, buffer)?;
        Ok((segment(0xA1, [0; 7]), written))
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
