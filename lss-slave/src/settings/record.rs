//! A record of the settings log: 32 bytes that are either all valid or not valid.

use super::Settings;
use crate::{BitRateSetting, NodeId};

/// The size of a record in bytes.
pub const LEN: u32 = 32;
/// The last word, written only after all the others have been read back.
pub const COMMIT: [u8; 4] = *b"LSS1";
/// The last word of parameters. It has a bit that the commit word has not, so it cannot read as one, even half written.
const PARAMETERS: [u8; 4] = *b"LSSP";
/// The number of bytes of the parameters in 32 bytes of flash.
pub const PARAMETERS_LEN: usize = 24;

/// A record: its sequence number and the settings, `None` if the defaults of the device apply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Record {
    pub sequence: u32,
    pub settings: Option<Settings>,
}

impl Record {
    /// The record in flash: sequence (4 bytes, little endian), kind, node-ID, bit rate index, 1 byte unused, heartbeat
    /// time (2 bytes), reference to the parameters (8 bytes), 6 bytes unused, CRC-32 of the bytes before it, commit
    /// word.
    pub fn to_bytes(self, parameters: Option<Reference>) -> [u8; LEN as usize] {
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
        let [p0, p1, p2, p3, p4, p5, p6, p7] = parameters.map_or([X; 8], Reference::to_bytes);
        #[rustfmt::skip]
        let content = [
            s0, s1, s2, s3, kind, node_id, index, X, h0, h1, p0, p1,
            p2, p3, p4, p5, p6, p7, X, X, X, X, X, X,
        ];
        let [r0, r1, r2, r3] = crc32(&content).to_le_bytes();
        let [c0, c1, c2, c3] = COMMIT;
        let mut bytes = [X; LEN as usize];
        let (head, tail) = bytes.split_at_mut(content.len());
        head.copy_from_slice(&content);
        tail.copy_from_slice(&[r0, r1, r2, r3, c0, c1, c2, c3]);
        bytes
    }

    /// The record in `bytes`, if it is complete, undamaged and holds possible settings.
    pub fn from_bytes(bytes: &[u8; LEN as usize]) -> Option<Self> {
        let (content, rest) = bytes.split_first_chunk::<24>()?;
        let (crc, commit) = rest.split_first_chunk()?;
        if commit != COMMIT || u32::from_le_bytes(*crc) != crc32(content) {
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
        Some(Self { sequence: u32::from_le_bytes([s0, s1, s2, s3]), settings })
    }

    /// Whether this record was written after `other`; sequence numbers wrap.
    pub fn is_newer_than(&self, other: &Self) -> bool {
        self.sequence != other.sequence
            && self.sequence.wrapping_sub(other.sequence) <= u32::MAX / 2
    }
}

/// The place of the parameters that belong to a record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reference {
    /// The first place of 32 bytes, counted from the start of the bank.
    pub first: u16,
    /// The number of bytes.
    pub len: u16,
    /// The CRC-32 of the bytes.
    pub crc: u32,
}

impl Reference {
    /// The number of places of 32 bytes.
    pub const fn places(self) -> u32 {
        (self.len as u32).div_ceil(PARAMETERS_LEN as u32)
    }

    fn to_bytes(self) -> [u8; 8] {
        let ([f0, f1], [l0, l1]) = (self.first.to_le_bytes(), self.len.to_le_bytes());
        let [c0, c1, c2, c3] = self.crc.to_le_bytes();
        [f0, f1, l0, l1, c0, c1, c2, c3]
    }

    /// The reference in a record, if it has parameters.
    pub fn of_record(bytes: &[u8; LEN as usize]) -> Option<Self> {
        let [_, _, _, _, _, _, _, _, _, _, f0, f1, l0, l1, c0, c1, c2, c3, ..] = *bytes;
        let len = u16::from_le_bytes([l0, l1]);
        (len != u16::MAX).then_some(Self {
            first: u16::from_le_bytes([f0, f1]),
            len,
            crc: u32::from_le_bytes([c0, c1, c2, c3]),
        })
    }
}

/// 32 bytes of flash with a part of the parameters: sequence, 24 bytes of them, a word that is not the commit word.
/// The sequence comes first, as in a record: a place where the first word may be half written gets the same word again.
pub fn parameters_to_bytes(sequence: u32, part: [u8; PARAMETERS_LEN]) -> [u8; LEN as usize] {
    let mut bytes = [0xFF; LEN as usize];
    let (head, rest) = bytes.split_at_mut(4);
    head.copy_from_slice(&sequence.to_le_bytes());
    let (content, end) = rest.split_at_mut(PARAMETERS_LEN);
    content.copy_from_slice(&part);
    end.copy_from_slice(&PARAMETERS);
    bytes
}

/// The part of the parameters in 32 bytes of flash.
pub fn parameters_from_bytes(bytes: &[u8; LEN as usize]) -> &[u8] {
    bytes.get(4..4 + PARAMETERS_LEN).unwrap_or_default()
}

const KIND_SETTINGS: u8 = 0x01;
const KIND_DEFAULTS: u8 = 0x00;

/// CRC-32 as in IEEE 802.3, bit by bit: the code is small, and a start checks at most a thousand records.
fn crc32(bytes: &[u8]) -> u32 {
    !crc32_of_more(u32::MAX, bytes)
}

/// Continues a CRC-32, which begins with all ones and is inverted at the end.
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
        assert_eq!(super::crc32(b"123456789"), 0xCBF4_3926);
    }
}
