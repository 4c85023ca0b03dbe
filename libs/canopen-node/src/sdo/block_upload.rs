//! SDO block upload (CiA 301, 7.2.4.3.13 to 7.2.4.3.15).

use super::{Abort, Message, Objects, crc::Crc, upload::Upload};

/// The legal block sizes.
const BLOCK_SIZES: core::ops::RangeInclusive<u8> = 1..=127;

/// A block upload under way.
#[derive(Clone, Copy, Debug)]
pub(super) struct BlockUpload {
    pub upload: Upload,
    phase: Phase,
    block_size: u8,
    /// The first byte of the block.
    block_start: u32,
    /// The number of segments of the block that have been sent.
    sent: u8,
    /// The CRC of the data, if the client checks it.
    crc: Option<Crc>,
    /// The number of bytes in the CRC. Repeated segments are not added again.
    in_crc: u32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// The client has not started the first block.
    Beginning,
    Sending,
    /// The block has been sent, but not confirmed.
    Waiting,
    /// All data has been confirmed, but not the end.
    Ending,
}

impl BlockUpload {
    /// A block upload whose client checks data by CRC or not, and the answer to it.
    pub fn begin(upload: Upload, block_size: u8, has_crc: bool) -> Result<(Self, Message), Abort> {
        const CRC_SUPPORTED: u8 = 0x04;
        const SIZE_INDICATED: u8 = 0x02;
        if !BLOCK_SIZES.contains(&block_size) {
            return Err(Abort::BlockSize);
        }
        let command = 0xC0 | CRC_SUPPORTED | SIZE_INDICATED;
        let answer = Message::new(command, upload.address, upload.len());
        let transfer = Self {
            upload,
            phase: Phase::Beginning,
            block_size,
            block_start: 0,
            sent: 0,
            crc: has_crc.then(Crc::default),
            in_crc: 0,
        };
        Ok((transfer, answer))
    }

    /// Whether there is a segment to send.
    pub const fn is_sending(&self) -> bool {
        matches!(self.phase, Phase::Sending)
    }

    /// Handles a message of the client; returns the answer, if it has one, and whether the transfer has ended.
    pub fn handle(
        &mut self,
        command: u8,
        [confirmed, block_size, ..]: [u8; 7],
    ) -> Result<(Option<Message>, bool), Abort> {
        const END: u8 = 1;
        const CONFIRM: u8 = 2;
        const START: u8 = 3;
        match (command & 3, self.phase) {
            (START, Phase::Beginning) => self.phase = Phase::Sending,
            // A client that misses a segment may say so before the end of the block.
            (CONFIRM, Phase::Sending | Phase::Waiting) => {
                return Ok((self.confirm(confirmed, block_size)?, false));
            }
            (END, Phase::Ending) => return Ok((None, true)),
            _ => return Err(Abort::Command),
        }
        Ok((None, false))
    }

    fn confirm(&mut self, confirmed: u8, block_size: u8) -> Result<Option<Message>, Abort> {
        if confirmed > self.sent {
            return Err(Abort::SequenceNumber);
        }
        if confirmed == self.sent && self.phase == Phase::Waiting && self.upload.is_complete() {
            self.phase = Phase::Ending;
            // The last segment of 14 bytes is full, but the only one of no bytes is empty.
            let last = (self.upload.len() % 7) as u8;
            let unused =
                if last > 0 || self.upload.len() == 0 { 7_u8.saturating_sub(last) } else { 0 };
            let [c0, c1] = self.crc.map_or(0, Crc::value).to_le_bytes();
            return Ok(Some(Message::segment(0xC1 | unused << 2, [c0, c1, 0, 0, 0, 0, 0])));
        }
        if !BLOCK_SIZES.contains(&block_size) {
            return Err(Abort::BlockSize);
        }
        // The next block begins with the first segment that the client lacks. Only the last of all is shorter than 7.
        self.block_start = self.block_start.saturating_add(7 * u32::from(confirmed));
        self.upload.offset = self.block_start;
        (self.block_size, self.sent, self.phase) = (block_size, 0, Phase::Sending);
        Ok(None)
    }

    /// The next segment of the block.
    pub fn next_segment<O: Objects>(
        &mut self,
        objects: &O,
        buffer: &[u8],
    ) -> Result<Message, Abort> {
        const LAST: u8 = 0x80;
        let mut data = [0; 7];
        let len = self.upload.read(objects, buffer, &mut data)?;
        if let Some(crc) = &mut self.crc
            && self.upload.offset == self.in_crc
        {
            crc.add(data.get(..len).unwrap_or_default());
            self.in_crc = self.in_crc.saturating_add(len as u32);
        }
        self.upload.offset = self.upload.offset.saturating_add(len as u32);
        self.sent = self.sent.saturating_add(1);
        let is_last = self.upload.is_complete();
        if is_last || self.sent >= self.block_size {
            self.phase = Phase::Waiting;
        }
        Ok(Message::segment(self.sent | if is_last { LAST } else { 0 }, data))
    }
}
