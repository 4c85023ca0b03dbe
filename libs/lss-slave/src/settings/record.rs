//! A record of the settings log and a part of its parameters: 32 bytes each.
//!
//! # A record
//! Little endian. It is valid if the CRC and the commit word are right, the kind is known and the settings are legal.
//!
//! | bytes | content |
//! |---|---|
//! | 0..3 | sequence: greater by one with each place, later than all that can be read in both banks, wraps |
//! | 4 | kind: `01` settings, `00` the device's defaults apply |
//! | 5 | node-ID, `01`..`7F`; `FF` none |
//! | 6 | bit rate: index in the LSS table, `00`..`04`, `06`..`08`, `09` automatic |
//! | 7..9 | unused, `FF` |
//! | 10..11 | parameters: their first place, counted from the start of the bank |
//! | 12..13 | length of the parameters in bytes; `FFFF` none |
//! | 14..17 | CRC-32 of the parameters |
//! | 18..21 | `FF`; where an earlier version has others, its record is of another layout |
//! | 22 | state of the [other bank](OtherBank) |
//! | 23 | number of the layout: `FF` this one |
//! | 24..27 | CRC-32 (IEEE 802.3) of bytes 0..23; `0000 0000` stands for one that would read blank |
//! | 28..31 | commit word, `4C 53 53 31` ("LSS1") |
//!
//! Without parameters bytes 10..17 are `FF`. The CRC covers the unused bytes, so a later version can use them with kind
//! `01`: `FF` there means that an older version wrote the record. A version that reads or writes anything else otherwise
//! takes another number of the layout, and keeps byte 23, the CRC and the commit word where they are.
//!
//! # A part of the parameters
//!
//! | bytes | content |
//! |---|---|
//! | 0..3 | sequence |
//! | 4..27 | the next 24 bytes of the parameters; the rest of the last part is `FF` |
//! | 28..29 | the number of the part, from 0 on |
//! | 30..31 | `53 50` ("SP"): the place holds no record, whatever the bytes before read |
//!
//! A store of other parameters writes and reads back all parts, in order, and then the record that refers to them.

use super::Settings;
use crate::{BitRateSetting, NodeId, bytes::copy};

/// The size of a record in bytes.
pub const LEN: usize = 32;
/// The place of the CRC.
pub const CRC_AT: usize = 24;
/// The commit word, the last word of a record.
pub const COMMIT: [u8; 4] = *b"LSS1";
/// The last bytes of a part of the parameters. A bit is 0 in them that is 1 in the commit word, so they do not read as
/// its end, also if that is incomplete.
const PART: [u8; 2] = *b"SP";
/// The number of bytes of a part of the parameters.
pub const PART_LEN: usize = 24;

/// A record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Record {
    pub sequence: u32,
    /// The settings; `None` if the defaults of the device apply.
    pub settings: Option<Settings>,
    pub parameters: Option<Reference>,
    pub other_is: OtherBank,
}

impl Record {
    /// The record in flash.
    pub fn to_bytes(self) -> [u8; LEN] {
        let [s0, s1, s2, s3] = self.sequence.to_le_bytes();
        let (kind, node_id, index) = match self.settings {
            None => (KIND_DEFAULTS, 0xFF, 0xFF),
            Some(settings) => {
                (KIND_SETTINGS, NodeId::to_lss(settings.node_id), settings.bit_rate.index())
            }
        };
        const X: u8 = 0xFF;
        let [p0, p1, p2, p3, p4, p5, p6, p7] = self.parameters.map_or([X; 8], Reference::to_bytes);
        #[rustfmt::skip]
        let content = [
            s0, s1, s2, s3, kind, node_id, index, X, X, X, p0, p1,
            p2, p3, p4, p5, p6, p7, X, X, X, X, self.other_is as u8, X,
        ];
        let [r0, r1, r2, r3] = crc_of(&content);
        let [c0, c1, c2, c3] = COMMIT;
        let mut bytes = [X; LEN];
        let (head, tail) = bytes.split_at_mut(content.len());
        head.copy_from_slice(&content);
        tail.copy_from_slice(&[r0, r1, r2, r3, c0, c1, c2, c3]);
        bytes
    }

    /// The record in `bytes`, if it is undamaged and holds possible settings.
    pub fn from_bytes(bytes: &[u8; LEN]) -> Option<Self> {
        let content = sealed(bytes)?;
        let [s0, s1, s2, s3, kind, node_id, index, .., other, _] = *content;
        let settings = match kind {
            _ if !has_this_layout(content) => return None,
            KIND_DEFAULTS => None,
            KIND_SETTINGS => Some(Settings {
                node_id: NodeId::from_lss(node_id).ok()?,
                bit_rate: BitRateSetting::from_table(0, index)?,
            }),
            _ => return None,
        };
        let sequence = u32::from_le_bytes([s0, s1, s2, s3]);
        let other_is = match other {
            2 => OtherBank::Erased,
            _ => OtherBank::Used,
        };
        Some(Self { sequence, settings, parameters: Reference::of_record(bytes), other_is })
    }
}

/// The content of a record of any layout, if it is undamaged.
fn sealed(bytes: &[u8; LEN]) -> Option<&[u8; CRC_AT]> {
    let (content, rest) = bytes.split_first_chunk()?;
    let (crc, commit) = rest.split_first_chunk()?;
    (*commit == COMMIT && *crc == crc_of(content)).then_some(content)
}

/// Whether these bytes are a record of another layout. Those before this one have the same number, at other addresses.
pub fn is_of_other_layout(bytes: &[u8; LEN], is_place: bool) -> bool {
    sealed(bytes).is_some_and(|content| !is_place || !has_this_layout(content))
}

const fn has_this_layout(content: &[u8; CRC_AT]) -> bool {
    matches!(content, [.., 0xFF, 0xFF, 0xFF, 0xFF, _, 0xFF])
}

/// What a record says of the other bank.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OtherBank {
    /// It may hold anything. Earlier versions wrote 1, too.
    Used = 0,
    /// It was erased completely, and no erase has begun since.
    Erased = 2,
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

/// The places of the parameters of a record, counted from the start of the bank.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reference {
    /// The place of the first part of the parameters.
    pub first: u16,
    /// The number of bytes of the parameters.
    pub len: u16,
    /// The CRC-32 of these bytes.
    pub crc: u32,
}

impl Reference {
    fn to_bytes(self) -> [u8; 8] {
        let ([f0, f1], [l0, l1]) = (self.first.to_le_bytes(), self.len.to_le_bytes());
        let [c0, c1, c2, c3] = self.crc.to_le_bytes();
        [f0, f1, l0, l1, c0, c1, c2, c3]
    }

    /// The reference in a record, if it has parameters.
    fn of_record(bytes: &[u8; LEN]) -> Option<Self> {
        let [_, _, _, _, _, _, _, _, _, _, f0, f1, l0, l1, c0, c1, c2, c3, ..] = *bytes;
        let len = u16::from_le_bytes([l0, l1]);
        (len != u16::MAX).then_some(Self {
            first: u16::from_le_bytes([f0, f1]),
            len,
            crc: u32::from_le_bytes([c0, c1, c2, c3]),
        })
    }
}

/// 32 bytes of flash with a part of the parameters: sequence, 24 bytes of them, the number of the part, two bytes that
/// the commit word has not.
pub fn part_to_bytes(sequence: u32, number: u16, part: &[u8; PART_LEN]) -> [u8; LEN] {
    let ([n0, n1], [p0, p1]) = (number.to_le_bytes(), PART);
    let mut bytes = [0xFF; LEN];
    for (at, from) in
        [(0, &sequence.to_le_bytes()[..]), (4, part), (4 + PART_LEN, &[n0, n1, p0, p1])]
    {
        copy(from, 0, bytes.get_mut(at..).unwrap_or_default());
    }
    bytes
}

/// The part in 32 bytes of flash.
pub fn part_from_bytes(bytes: &[u8; LEN]) -> [u8; PART_LEN] {
    let [_, _, _, _, part @ .., _, _, _, _] = *bytes;
    part
}

const KIND_SETTINGS: u8 = 0x01;
const KIND_DEFAULTS: u8 = 0x00;

/// Continues a CRC-32 as in IEEE 802.3, which begins with all ones and is inverted at the end. Bit by bit: the code is
/// small, and a start checks at most a thousand records.
#[inline(never)] // Inlined, it takes 100 bytes more.
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
