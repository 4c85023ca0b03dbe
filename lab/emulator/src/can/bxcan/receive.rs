//! A receive FIFO of three messages with RFR and its output mailbox (RM0090 32.7.3, 32.9.2).

use std::collections::VecDeque;

use super::{Frame, filters::identifier_word};
use crate::Time;

const DEPTH: usize = 3;

const FULL: u32 = 1 << 3;
const FOVR: u32 = 1 << 4;
const RFOM: u32 = 1 << 5;

/// Bits of the FIFO in IER, shifted down to its FMPIE.
const FMPIE: u32 = 1 << 0;
const FFIE: u32 = 1 << 1;
const FOVIE: u32 = 1 << 2;

/// RIR, RDTR, RDLR and RDHR.
type Message = [u32; 4];

#[derive(Debug, Default)]
pub struct Fifo {
    messages: VecDeque<Message>,
    /// The content of the output mailbox while the FIFO is empty, and until the release is complete.
    released: Message,
    released_at: Time,
    /// FULL and FOVR.
    flags: u32,
}

impl Fifo {
    /// Stores a frame with the index of the filter that accepted it and its time stamp. If the FIFO is full, the new
    /// frame is dropped if it is locked, and replaces the newest otherwise.
    pub fn push(&mut self, frame: &Frame, filter_match: u8, stamp: u16, locked: bool) {
        let data = u64::from_le_bytes(frame.data);
        let message = [
            identifier_word(frame),
            u32::from(frame.dlc) | u32::from(filter_match) << 8 | u32::from(stamp) << 16,
            data as u32,
            (data >> 32) as u32,
        ];
        if self.messages.len() == DEPTH {
            self.flags |= FOVR;
            if locked {
                return;
            }
            self.messages.pop_back();
        }
        self.messages.push_back(message);
        if self.messages.len() == DEPTH {
            self.flags |= FULL;
        }
    }

    /// RF0R or RF1R.
    pub fn rfr(&self, now: Time) -> u32 {
        let messages = self.messages.len() as u32;
        self.flags | if now < self.released_at { RFOM | (messages + 1) } else { messages }
    }

    /// Discards its messages, as a master reset does.
    pub fn clear(&mut self) {
        self.messages.clear();
    }

    /// Clears FULL and FOVR where 1 is written. RFOM releases the output mailbox at `release_at` and clears FULL,
    /// although the manual says that only software clears it (confidence 0.85).
    pub fn write_rfr(&mut self, value: u32, release_at: Time) {
        self.flags &= !(value & (FULL | FOVR));
        if value & RFOM != 0
            && let Some(message) = self.messages.pop_front()
        {
            self.released = message;
            self.released_at = release_at;
            self.flags &= !FULL;
        }
    }

    /// A word of the output mailbox.
    pub fn read(&self, word: usize, now: Time) -> u32 {
        let next = self.messages.front().filter(|_| self.released_at <= now);
        next.unwrap_or(&self.released)[word]
    }

    /// The level of the interrupt line with these enable bits.
    pub fn irq(&self, enable: u32) -> bool {
        (enable & FMPIE != 0 && !self.messages.is_empty())
            || (enable & FFIE != 0 && self.flags & FULL != 0)
            || (enable & FOVIE != 0 && self.flags & FOVR != 0)
    }
}
