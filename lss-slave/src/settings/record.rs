//! A record of the settings log: 32 bytes that are either all valid or not valid.

use super::Settings;
use crate::{BitRateSetting, NodeId};

/// The size of a record in bytes.
pub const LEN: u32 = 32;
/// The last word, written only after all the others have been read back.
pub const COMMIT: [u8; 4] = *b"LSS1";

/// A record: its sequence number and the settings, `None` if the defaults of the device apply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Record {
    pub sequence: u32,
    pub settings: Option<Settings>,
}

impl Record {
    /// The record in flash: sequence (4 bytes, little endian), kind, node-ID, bit rate index, 1 byte unused, heartbeat
    /// time (2 bytes), 14 bytes unused, CRC-32 of the bytes before it, commit word.
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
        #[rustfmt::skip]
        let content = [
            s0, s1, s2, s3, kind, node_id, index, X, h0, h1, X, X,
            X, X, X, X, X, X, X, X, X, X, X, X,
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

const KIND_SETTINGS: u8 = 0x01;
const KIND_DEFAULTS: u8 = 0x00;

/// CRC-32 as in IEEE 802.3, bit by bit: the code is small, and a start checks at most a thousand records.
fn crc32(bytes: &[u8]) -> u32 {
    let mut crc = u32::MAX;
    for byte in bytes {
        crc ^= u32::from(*byte);
        for _ in 0..8 {
            crc = if crc & 1 == 1 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 };
        }
    }
    !crc
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_crc_is_the_one_of_ieee_802_3() {
        assert_eq!(super::crc32(b"123456789"), 0xCBF4_3926);
    }
}
