//! The three transmit mailboxes and TSR (RM0090 32.7.1, 32.9.2).

use super::Frame;
use crate::{Time, can::Id};

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
    /// The time and the running number of the transmit request, while the mailbox is not empty.
    request: Option<(Time, u64)>,
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
        self.request = None;
        self.status = self.status & !ABRQ | RQCP | status;
    }
}

#[derive(Debug, Default)]
pub struct Mailboxes {
    mailboxes: [Mailbox; 3],
    requests: u64,
    /// The mailbox whose frame was offered to the controller, or is under way.
    scheduled: Option<usize>,
    sending: Option<usize>,
}

impl Mailboxes {
    /// Whether a request has completed and is not yet cleared.
    pub fn any_completed(&self) -> bool {
        self.mailboxes.iter().any(|mailbox| mailbox.status & RQCP != 0)
    }

    /// TIR, TDTR, TDLR or TDHR.
    pub fn read(&self, mailbox: usize, word: usize) -> u32 {
        let mailbox = &self.mailboxes[mailbox];
        mailbox.words[word] | u32::from(word == 0 && mailbox.request.is_some())
    }

    /// Writes TIR, TDTR, TDLR or TDHR of an empty mailbox; others are protected. Returns the frame to send if TXRQ is
    /// set.
    pub fn write(&mut self, mailbox: usize, word: usize, value: u32, now: Time) -> Option<Frame> {
        let mailbox = &mut self.mailboxes[mailbox];
        if mailbox.request.is_some() {
            return None;
        }
        mailbox.words[word] = match word {
            0 => value & !TIR_TXRQ,
            1 => value & TDTR_WRITABLE,
            _ => value,
        };
        if word != 0 || value & TIR_TXRQ == 0 {
            return None;
        }
        self.requests += 1;
        mailbox.request = Some((now, self.requests));
        mailbox.status = 0;
        Some(mailbox.frame())
    }

    /// TSR; `chronological` is TXFP.
    pub fn tsr(&self, chronological: bool) -> u32 {
        let order = self.order(chronological);
        let mut tsr = 0;
        for (number, mailbox) in self.mailboxes.iter().enumerate() {
            tsr |= mailbox.status << (8 * number);
            tsr |= u32::from(mailbox.request.is_none()) << TME_SHIFT << number;
        }
        let lowest = order.last().copied();
        if let (true, Some(lowest)) = (order.len() > 1, lowest) {
            tsr |= 1 << LOW_SHIFT << lowest;
        }
        let free = self.mailboxes.iter().position(|mailbox| mailbox.request.is_none());
        tsr | (free.or(lowest).unwrap_or(0) as u32) << CODE_SHIFT
    }

    /// Writes TSR: clears status and requests aborts. Returns the frames that were aborted at once; a frame that is
    /// under way or chosen next is finished first.
    pub fn write_tsr(&mut self, value: u32, chosen: bool) -> [Option<Frame>; 3] {
        let spared = if chosen { self.scheduled } else { self.sending };
        let mut aborted = [None; 3];
        for (number, mailbox) in self.mailboxes.iter_mut().enumerate() {
            let bits = value >> (8 * number);
            let cleared = if bits & RQCP != 0 {
                RQCP | TXOK | ALST | TERR
            } else {
                bits & (TXOK | ALST | TERR)
            };
            mailbox.status &= !cleared;
            if bits & ABRQ != 0 && mailbox.request.is_some() {
                if spared == Some(number) {
                    mailbox.status |= ABRQ;
                } else {
                    aborted[number] = Some(mailbox.frame());
                    mailbox.complete(0);
                }
            }
        }
        aborted
    }

    /// Empties mailboxes whose abort waited for a start of transmission that did not happen.
    /// Returns their frames.
    pub fn finish_aborts(&mut self) -> [Option<Frame>; 3] {
        let mut aborted = [None; 3];
        for (number, mailbox) in self.mailboxes.iter_mut().enumerate() {
            if mailbox.status & ABRQ != 0 && self.sending != Some(number) {
                aborted[number] = Some(mailbox.frame());
                mailbox.complete(0);
            }
        }
        aborted
    }

    /// Chooses the next mailbox to send: its frame and the time of its request.
    pub fn schedule(&mut self, chronological: bool) -> Option<(Frame, Time)> {
        self.scheduled = self.order(chronological).first().copied();
        let mailbox = &self.mailboxes[self.scheduled?];
        mailbox.request.map(|(since, _)| (mailbox.frame(), since))
    }

    /// Notes that the scheduled frame is under way.
    pub fn started(&mut self) {
        self.sending = self.scheduled;
    }

    /// Notes that the frame under way was sent; `stamp` is its time stamp, if time stamps are on.
    pub fn transmitted(&mut self, stamp: Option<u16>) {
        if let Some(sent) = self.sending.take() {
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
        if let Some(failed) = self.sending.take() {
            let mailbox = &mut self.mailboxes[failed];
            mailbox.status = mailbox.status & !(ALST | TERR) | reason;
            if one_shot {
                mailbox.complete(0);
            }
        }
    }

    /// Numbers of the mailboxes that are not empty, highest priority first: by identifier and then number, or by order
    /// of request.
    fn order(&self, chronological: bool) -> Vec<usize> {
        let mut order: Vec<usize> =
            (0..3).filter(|&number| self.mailboxes[number].request.is_some()).collect();
        order.sort_by_key(|&number| match self.mailboxes[number].request {
            Some((_, request)) if chronological => request,
            _ => u64::from(self.mailboxes[number].frame().arbitration()),
        });
        order
    }
}
