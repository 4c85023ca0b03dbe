//! A download on its way into the flash: the header in RAM, and a ring of the words after it.

use crate::{
    ROW,
    header::{HEADER_LEN, Header},
};

/// The bytes of the header.
const HEADER: u32 = HEADER_LEN as u32;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Phase {
    None,
    Receiving,
    /// The client waits for the answer to the end.
    Ended,
}

/// Where the check of the signature is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Proof {
    /// There is no header, or it needs none.
    None,
    Wanted,
    UnderWay,
    Given,
}

pub(crate) struct Download<const WORDS: usize> {
    pub phase: Phase,
    pub proof: Proof,
    /// The header, once it is accepted.
    pub header: Option<Header>,
    bytes: [u8; HEADER_LEN],
    /// The bytes that have come, with those of the header.
    received: u32,
    /// The bytes of a word that is not complete.
    partial: u32,
    ring: [u32; WORDS],
    first: usize,
    len: usize,
    /// The words that were taken from the ring.
    pub taken: u32,
}

impl<const WORDS: usize> Download<WORDS> {
    pub fn new() -> Self {
        Self {
            phase: Phase::None,
            proof: Proof::None,
            header: None,
            bytes: [0; HEADER_LEN],
            received: 0,
            partial: 0,
            ring: [0; WORDS],
            first: 0,
            len: 0,
            taken: 0,
        }
    }

    pub fn begin(&mut self, phase: Phase) {
        (self.phase, self.proof) = (phase, Proof::None);
        self.header = None;
        (self.received, self.partial, self.taken) = (0, 0, 0);
        (self.first, self.len) = (0, 0);
    }

    pub fn bytes(&self) -> &[u8; HEADER_LEN] {
        &self.bytes
    }

    /// The word of the header at an offset.
    pub fn header_word(&self, offset: u32) -> u32 {
        let bytes = self.bytes.get(offset as usize..).and_then(<[u8]>::first_chunk);
        bytes.copied().map_or(0, u32::from_le_bytes)
    }

    pub fn received(&self) -> u32 {
        self.received
    }

    /// The length of the whole file, as its header says.
    pub fn expected_len(&self) -> u32 {
        self.header.map_or(HEADER, |header| header.length.saturating_add(HEADER))
    }

    /// The bytes of the header that have not come yet.
    pub fn header_left(&self) -> usize {
        HEADER.saturating_sub(self.received) as usize
    }

    /// The bytes that [`take`](Self::take) has room for.
    pub fn room(&self) -> usize {
        let words = WORDS.saturating_sub(self.len);
        (words.saturating_mul(4))
            .saturating_sub((self.received % 4) as usize)
            .saturating_add(self.header_left())
    }

    /// Takes the next bytes, for which there is room.
    pub fn take(&mut self, bytes: &[u8]) {
        for byte in bytes {
            if let Some(place) = self.bytes.get_mut(self.received as usize) {
                *place = *byte;
            } else {
                let place = 8 * (self.received % 4);
                self.partial |= u32::from(*byte) << place;
                if place == 24 {
                    self.push();
                }
            }
            self.received = self.received.wrapping_add(1);
        }
    }

    fn push(&mut self) {
        if let Some(place) = self.ring.get_mut(wrapped::<WORDS>(self.first, self.len)) {
            *place = self.partial;
            self.len = self.len.wrapping_add(1);
        }
        self.partial = 0;
    }

    /// Fills a row with the words that come next into the flash; returns their number.
    pub fn take_row(&mut self, row: &mut [u32; ROW]) -> u32 {
        let words = self.ring.iter().skip(self.first).take(self.len);
        let len = row.iter_mut().zip(words).map(|(place, word)| *place = *word).count();
        self.len = self.len.saturating_sub(len);
        self.first = wrapped::<WORDS>(self.first, len);
        self.taken = self.taken.wrapping_add(len as u32);
        len as u32
    }

    pub fn is_empty(&self) -> bool {
        self.len == 0
    }
}

fn wrapped<const WORDS: usize>(first: usize, more: usize) -> usize {
    let sum = first.wrapping_add(more);
    if sum >= WORDS { sum.wrapping_sub(WORDS) } else { sum }
}
