//! A record of the settings log: 32 bytes that are either all valid or not valid.
//!
//! Its words are written in order. All but the last make it valid, and the last one is begun only when these are
//! complete: a record with anything in its last word is certain, it reads as valid at every start.

use super::Settings;
use crate::{BitRateSetting, NodeId, bytes::copy};

/// The size of a record in bytes.
pub const LEN: u32 = 32;

/// Whether a program unit of this many bytes is larger than a word.
pub const fn is_wide(write_size: usize) -> bool {
    write_size > 4
}

/// The number of bytes that a place takes where the program unit has this many: a record, and where units are wide, one
/// before and one after it.
pub const fn place_len(write_size: usize) -> u32 {
    if is_wide(write_size) { LEN + 2 * write_size as u32 } else { LEN }
}

/// The places of the CRC and of the last word.
pub const CRC_AT: usize = 24;
pub const LAST_AT: usize = 28;
/// The number of places at the end of a bank that only starts use, where units are wide.
pub const RESERVE: u32 = 8;
/// The commit word, the last word of a record.
pub const COMMIT: [u8; 4] = *b"LSS1";
/// The place of the byte that says how the other bank is, where units are wide.
const OTHER_BANK_AT: usize = 22;
/// The last bytes of a part of the parameters. A bit is 0 in them that is 1 in the commit word, so they do not read as
/// its end, also if that is incomplete.
const PART: [u8; 2] = *b"SP";
/// The last word of the mark, which does not read as the commit word either.
const MARK: [u8; 4] = *b"LSSE";
/// The bytes of a mark between its sequence and its last word that are written; the others stay blank.
pub const MARK_LEN: usize = 4;
/// A word that makes a mark invalid, and its place in the mark, which is blank before.
pub const VOID: [u8; 4] = [0; 4];
pub const VOID_AT: u32 = 16;
/// The number of bytes of a part of the parameters, for which 32 bytes of flash have room.
pub const PART_LEN: usize = 24;

/// A record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Record {
    pub sequence: u32,
    /// The settings; `None` if the defaults of the device apply.
    pub settings: Option<Settings>,
    pub parameters: Option<Reference>,
}

impl Record {
    /// The record in flash: sequence (4 bytes, little endian), kind, node-ID, bit rate index, 1 byte unused, heartbeat
    /// time (2 bytes), reference to the parameters (12 bytes), 2 bytes unused, CRC-32 of the bytes before it, commit
    /// word.
    pub fn to_bytes(self) -> [u8; LEN as usize] {
        let [s0, s1, s2, s3] = self.sequence.to_le_bytes();
        let (kind, node_id, index, [h0, h1]) = match self.settings {
            None => (KIND_DEFAULTS, 0xFF, 0xFF, [0xFF; 2]),
            Some(settings) => (
                KIND_SETTINGS,
                NodeId::to_lss(settings.node_id),
                settings.bit_rate.index(),
                settings.heartbeat_ms.to_le_bytes(),
            ),
        };
        const X: u8 = 0xFF;
        let [p0, p1, p2, p3, p4, p5, p6, p7, p8, p9, p10, p11] =
            self.parameters.map_or([X; 12], Reference::to_bytes);
        #[rustfmt::skip]
        let content = [
            s0, s1, s2, s3, kind, node_id, index, X, h0, h1, p0, p1,
            p2, p3, p4, p5, p6, p7, p8, p9, p10, p11, X, X,
        ];
        let [r0, r1, r2, r3] = crc_of(&content);
        let [c0, c1, c2, c3] = COMMIT;
        let mut bytes = [X; LEN as usize];
        let (head, tail) = bytes.split_at_mut(content.len());
        head.copy_from_slice(&content);
        tail.copy_from_slice(&[r0, r1, r2, r3, c0, c1, c2, c3]);
        bytes
    }

    /// The record in `bytes`, if it is undamaged and holds possible settings. Its commit word may be incomplete.
    pub fn from_bytes(bytes: &[u8; LEN as usize]) -> Option<Self> {
        let (content, rest) = bytes.split_first_chunk::<CRC_AT>()?;
        let (crc, commit) = rest.split_first_chunk()?;
        // An incomplete word has more bits at 1.
        let is_commit = commit.iter().zip(COMMIT).all(|(byte, whole)| byte & whole == whole);
        if !is_commit || *crc != crc_of(content) {
            return None;
        }
        let [s0, s1, s2, s3, kind, node_id, index, _, h0, h1, ..] = *content;
        let settings = match kind {
            KIND_DEFAULTS => None,
            KIND_SETTINGS => Some(Settings {
                node_id: NodeId::from_lss(node_id).ok()?,
                bit_rate: BitRateSetting::from_table(0, index)?,
                heartbeat_ms: u16::from_le_bytes([h0, h1]),
            }),
            _ => return None,
        };
        let sequence = u32::from_le_bytes([s0, s1, s2, s3]);
        Some(Self { sequence, settings, parameters: Reference::of_record(bytes) })
    }
}

/// Whether the last word was begun.
pub fn is_certain(bytes: &[u8; LEN as usize]) -> bool {
    !bytes.ends_with(&[0xFF; 4])
}

/// What a record says of the other bank where units are wide.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OtherBank {
    /// It may hold anything.
    Used = 0,
    /// It may be erased: the record before, which says that it is used, is certain.
    Doomed = 1,
    /// It was erased completely, and no erase has begun since.
    Erased = 2,
}

impl OtherBank {
    /// What a record says.
    pub fn of_record(bytes: &[u8; LEN as usize]) -> Self {
        match bytes.get(OTHER_BANK_AT) {
            Some(1) => Self::Doomed,
            Some(2) => Self::Erased,
            _ => Self::Used,
        }
    }

    /// The record with this, and its CRC anew.
    pub fn add_to(self, mut bytes: [u8; LEN as usize]) -> [u8; LEN as usize] {
        copy(&[self as u8], 0, bytes.get_mut(OTHER_BANK_AT..).unwrap_or_default());
        let crc = bytes.first_chunk().map(crc_of).unwrap_or_default();
        copy(&crc, 0, bytes.get_mut(CRC_AT..).unwrap_or_default());
        bytes
    }
}

/// The word that makes a record of this content valid: its CRC-32, but never a word that reads blank.
fn crc_of(content: &[u8; CRC_AT]) -> [u8; 4] {
    match !crc32_of_more(u32::MAX, content) {
        u32::MAX => [0; 4],
        crc => crc.to_le_bytes(),
    }
}

/// Whether a sequence number is later than `other`; they wrap.
pub fn is_newer(sequence: u32, other: u32) -> bool {
    sequence != other && sequence.wrapping_sub(other) <= u32::MAX / 2
}

/// The places of the parameters of a record, counted from the start of the bank in units of 32 bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reference {
    /// The first place with parts of the parameters.
    pub first: u16,
    /// The number of bytes of the parameters.
    pub len: u16,
    /// The CRC-32 of these bytes.
    pub crc: u32,
    /// `None`: all parts begin at `first`, in order.
    pub changes: Option<Changes>,
}

/// The parts that a store has changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Changes {
    /// The number of parts that begin at [`first`](Reference::first).
    pub parts: u16,
    /// The place of the record to whose parameters the other parts belong.
    pub others: u16,
}

impl Reference {
    /// The first place after the parts.
    pub fn end(&self) -> u32 {
        let parts = self
            .changes
            .map_or(usize::from(self.len).div_ceil(PART_LEN), |changes| changes.parts.into());
        u32::from(self.first).saturating_add(parts as u32)
    }

    fn to_bytes(self) -> [u8; 12] {
        let Changes { parts, others } = self.changes.unwrap_or(NO_CHANGES);
        let ([f0, f1], [l0, l1]) = (self.first.to_le_bytes(), self.len.to_le_bytes());
        let [c0, c1, c2, c3] = self.crc.to_le_bytes();
        let ([p0, p1], [o0, o1]) = (parts.to_le_bytes(), others.to_le_bytes());
        [f0, f1, l0, l1, c0, c1, c2, c3, p0, p1, o0, o1]
    }

    /// The reference in a record, if it has parameters.
    pub fn of_record(bytes: &[u8; LEN as usize]) -> Option<Self> {
        let [_, _, _, _, _, _, _, _, _, _, rest @ ..] = *bytes;
        let [f0, f1, l0, l1, c0, c1, c2, c3, p0, p1, o0, o1, ..] = rest;
        let changes =
            Changes { parts: u16::from_le_bytes([p0, p1]), others: u16::from_le_bytes([o0, o1]) };
        let len = u16::from_le_bytes([l0, l1]);
        (len != u16::MAX).then_some(Self {
            first: u16::from_le_bytes([f0, f1]),
            len,
            crc: u32::from_le_bytes([c0, c1, c2, c3]),
            changes: (changes != NO_CHANGES).then_some(changes),
        })
    }
}

const NO_CHANGES: Changes = Changes { parts: u16::MAX, others: u16::MAX };

/// 32 bytes of flash with a part of the parameters: sequence, 24 bytes of them, the number of the part, two bytes that
/// the commit word has not.
pub fn part_to_bytes(sequence: u32, number: u16, part: &[u8; PART_LEN]) -> [u8; LEN as usize] {
    let ([n0, n1], [p0, p1]) = (number.to_le_bytes(), PART);
    place_to_bytes(sequence, part, [n0, n1, p0, p1])
}

/// The number of a part, and the part, in 32 bytes of flash.
pub fn part_from_bytes(bytes: &[u8; LEN as usize]) -> (u16, [u8; PART_LEN]) {
    let [_, _, _, _, part @ .., n0, n1, _, _] = *bytes;
    (u16::from_le_bytes([n0, n1]), part)
}

/// The mark: the first 32 bytes of a bank whose erase was completed. They hold the sequence number and its complement.
pub fn mark_to_bytes(sequence: u32) -> [u8; LEN as usize] {
    let mut content = [0xFF; PART_LEN];
    copy(&(!sequence).to_le_bytes(), 0, &mut content);
    place_to_bytes(sequence, &content, MARK)
}

/// The sequence number in a mark.
pub fn mark_from_bytes(bytes: &[u8; LEN as usize]) -> Option<u32> {
    let [s0, s1, s2, s3, ..] = *bytes;
    let sequence = u32::from_le_bytes([s0, s1, s2, s3]);
    (*bytes == mark_to_bytes(sequence)).then_some(sequence)
}

fn place_to_bytes(sequence: u32, content: &[u8; PART_LEN], end: [u8; 4]) -> [u8; LEN as usize] {
    let mut bytes = [0xFF; LEN as usize];
    copy(&sequence.to_le_bytes(), 0, &mut bytes);
    copy(content, 0, bytes.get_mut(4..).unwrap_or_default());
    copy(&end, 0, bytes.get_mut(4 + PART_LEN..).unwrap_or_default());
    bytes
}

const KIND_SETTINGS: u8 = 0x01;
const KIND_DEFAULTS: u8 = 0x00;

/// Continues a CRC-32 as in IEEE 802.3, which begins with all ones and is inverted at the end. Bit by bit: the code is
/// small, and a start checks at most a thousand records.
#[inline(never)] // It has several callers.
pub fn crc32_of_more(mut crc: u32, bytes: &[u8]) -> u32 {
    for byte in bytes {
        crc ^= u32::from(*byte);
        for _ in 0..8 {
            crc = if crc & 1 == 1 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 };
        }
    }
    crc
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_crc_is_the_one_of_ieee_802_3() {
        assert_eq!(!super::crc32_of_more(u32::MAX, b"123456789"), 0xCBF4_3926);
    }
}
