//! The three transmit mailboxes and TSR (RM0090 32.7.1, 32.9.2).

use super::Frame;
use crate::{
    Time,
    can::{
        Id,
        requests::{PLACES, Requests},
    },
};

const TIR_TXRQ: u32 = 1 << 0;
const TIR_RTR: u32 = 1 << 1;
const TIR_IDE: u32 = 1 << 2;
const TDTR_WRITABLE: u32 = 0xFFFF_010F;

/// Bits of a mailbox in its byte of TSR.
const RQCP: u32 = 1 << 0;
const TXOK: u32 = 1 << 1;
pub const ALST: u32 = 1 << 2;
pub const TERR: u32 = 1 << 3;
const ABRQ: u32 = 1 << 7;

const CODE_SHIFT: u32 = 24;
const TME_SHIFT: u32 = 26;
const LOW_SHIFT: u32 = 29;

#[derive(Debug, Default)]
struct Mailbox {
    /// TIR without TXRQ, TDTR, TDLR and TDHR.
    words: [u32; 4],
    /// RQCP, TXOK, ALST, TERR and ABRQ.
    status: u32,
}

impl Mailbox {
    fn frame(&self) -> Frame {
        let [tir, tdtr, low, high] = self.words;
        let id = if tir & TIR_IDE == 0 {
            Id::Standard((tir >> 21) as u16)
        } else {
            Id::Extended(tir >> 3)
        };
        let dlc = (tdtr & 0xF) as u8;
        if tir & TIR_RTR != 0 {
            return Frame::remote(id, dlc);
        }
        let bytes = (u64::from(high) << 32 | u64::from(low)).to_le_bytes();
        Frame::data(id, &bytes[..usize::from(dlc.min(8))]).with_dlc(dlc)
    }

    fn complete(&mut self, status: u32) {
        self.status = self.status & !ABRQ | RQCP | status;
    }
}

#[derive(Debug, Default)]
pub struct Mailboxes {
    mailboxes: [Mailbox; PLACES],
    requests: Requests,
}

impl Mailboxes {
    /// Whether a request has completed and is not yet cleared.
    pub fn any_completed(&self) -> bool {
        self.mailboxes.iter().any(|mailbox| mailbox.status & RQCP != 0)
    }

    /// TIR, TDTR, TDLR or TDHR.
    pub fn read(&self, mailbox: usize, word: usize) -> u32 {
        let is_requested = word == 0 && self.requests.is_pending(mailbox);
        self.mailboxes[mailbox].words[word] | u32::from(is_requested)
    }

    /// Writes TIR, TDTR, TDLR or TDHR of an empty mailbox; others are protected. Returns the frame to send if TXRQ is
    /// set.
    pub fn write(&mut self, number: usize, word: usize, value: u32, now: Time) -> Option<Frame> {
        if self.requests.is_pending(number) {
            return None;
        }
        let mailbox = &mut self.mailboxes[number];
        mailbox.words[word] = match word {
            0 => value & !TIR_TXRQ,
            1 => value & TDTR_WRITABLE,
            _ => value,
        };
        if word != 0 || value & TIR_TXRQ == 0 {
            return None;
        }
        mailbox.status = 0;
        let frame = mailbox.frame();
        self.requests.add(number, frame, now);
        Some(frame)
    }

    /// TSR; `chronological` is TXFP.
    pub fn tsr(&self, chronological: bool) -> u32 {
        let order = self.requests.order(chronological);
        let mut tsr = 0;
        for (number, mailbox) in self.mailboxes.iter().enumerate() {
            tsr |= mailbox.status << (8 * number);
            tsr |= u32::from(!self.requests.is_pending(number)) << TME_SHIFT << number;
        }
        let lowest = order.last().copied();
        if let (true, Some(lowest)) = (order.len() > 1, lowest) {
            tsr |= 1 << LOW_SHIFT << lowest;
        }
        tsr | (self.requests.free().or(lowest).unwrap_or(0) as u32) << CODE_SHIFT
    }

    /// Writes TSR: clears status and requests aborts. Returns the frames that were aborted at once; a frame that is
    /// under way or chosen next is finished first.
    pub fn write_tsr(&mut self, value: u32, chosen: bool) -> [Option<Frame>; PLACES] {
        let spared = self.requests.spared(chosen);
        let mut aborted = [None; PLACES];
        for (number, mailbox) in self.mailboxes.iter_mut().enumerate() {
            let bits = value >> (8 * number);
            let cleared = if bits & RQCP != 0 {
                RQCP | TXOK | ALST | TERR
            } else {
                bits & (TXOK | ALST | TERR)
            };
            mailbox.status &= !cleared;
            if bits & ABRQ != 0 && self.requests.is_pending(number) {
                if spared == Some(number) {
                    mailbox.status |= ABRQ;
                } else {
                    aborted[number] = self.requests.remove(number);
                    mailbox.complete(0);
                }
            }
        }
        aborted
    }

    /// Empties mailboxes whose abort waited for a start of transmission that did not happen.
    /// Returns their frames.
    pub fn finish_aborts(&mut self) -> [Option<Frame>; PLACES] {
        let mut aborted = [None; PLACES];
        let sending = self.requests.spared(false);
        for (number, mailbox) in self.mailboxes.iter_mut().enumerate() {
            if mailbox.status & ABRQ != 0 && sending != Some(number) {
                aborted[number] = self.requests.remove(number);
                mailbox.complete(0);
            }
        }
        aborted
    }

    /// Chooses the next mailbox to send: its frame and the time of its request.
    pub fn schedule(&mut self, chronological: bool) -> Option<(Frame, Time)> {
        self.requests.schedule(chronological)
    }

    /// Notes that the scheduled frame is under way.
    pub fn started(&mut self) {
        self.requests.started();
    }

    /// Notes that the frame under way was sent; `stamp` is its time stamp, if time stamps are on.
    pub fn transmitted(&mut self, stamp: Option<u16>) {
        if let Some(sent) = self.requests.ended() {
            self.requests.remove(sent);
            let mailbox = &mut self.mailboxes[sent];
            if let Some(stamp) = stamp {
                mailbox.words[1] = mailbox.words[1] & 0xFFFF | u32::from(stamp) << 16;
            }
            mailbox.status &= !(ALST | TERR);
            mailbox.complete(TXOK);
        }
    }

    /// Notes that the frame under way was not sent, for the reason ALST or TERR. Its mailbox becomes empty if it is
    /// one-shot.
    pub fn failed(&mut self, reason: u32, one_shot: bool) {
        if let Some(failed) = self.requests.ended() {
            let mailbox = &mut self.mailboxes[failed];
            mailbox.status = mailbox.status & !(ALST | TERR) | reason;
            if one_shot {
                self.requests.remove(failed);
                mailbox.complete(0);
            }
        }
    }
}
