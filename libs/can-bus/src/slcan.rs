//! What both sides of SLCAN (LAWICEL CANUSB) share: the lines of frames, and the numbers in the others.

use std::fmt;

/// The end of a command, and of all answers but a refusal.
pub const END: u8 = b'\r';
/// What some adapters send in its place, or behind it.
pub const LF: u8 = b'\n';
/// The answer to a command that is unknown, or not possible now. It has no other end.
pub const REFUSED: u8 = 0x07;
/// The longest line that is taken: a frame with eight bytes and a time stamp has 31 characters.
pub const LINE: usize = 64;
/// Time stamps count milliseconds and wrap to zero at this value.
pub const STAMPS_MS: u64 = 60_000;
/// The bit rates of `S0` to `S8` in kbit/s.
pub const RATES: [u16; 9] = [10, 20, 50, 100, 125, 250, 500, 800, 1000];
/// The flags in the answer to `F`, as the CANUSB has them. The last one: errors since the last question.
pub const WARNING: u8 = 0x04;
pub const ERROR_PASSIVE: u8 = 0x20;
pub const BUS_ERROR: u8 = 0x80;

/// A CAN frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Frame {
    /// 0..=7FFh; 0..=1FFF_FFFFh if it is extended.
    pub id: u32,
    pub is_extended: bool,
    pub is_remote: bool,
    /// The data length code, 0..=8.
    pub length: u8,
    /// Bytes past the data are zero; a remote frame has none.
    pub data: [u8; 8],
}

impl Frame {
    /// A data frame with at most eight bytes.
    pub fn new(id: u32, is_extended: bool, bytes: &[u8]) -> Self {
        let mut data = [0; 8];
        data[..bytes.len()].copy_from_slice(bytes);
        Self { id, is_extended, is_remote: false, length: bytes.len() as u8, data }
    }

    pub fn data(&self) -> &[u8] {
        &self.data[..if self.is_remote { 0 } else { self.length.into() }]
    }

    /// The frame of a line without its end, and the time in ms at which an adapter received it, if the line has that.
    pub fn parse(line: &str) -> Option<(Self, Option<u64>)> {
        let (kind, rest) = line.split_at_checked(1)?;
        let is_remote = kind.eq_ignore_ascii_case("r");
        if !is_remote && !kind.eq_ignore_ascii_case("t") {
            return None;
        }
        let is_extended = kind < "a";
        let (id, rest) = rest.split_at_checked(if is_extended { 8 } else { 3 })?;
        let id = hex(id).filter(|id| *id <= if is_extended { 0x1FFF_FFFF } else { 0x7FF })?;
        let (length, rest) = rest.split_at_checked(1)?;
        let length = hex(length).filter(|length| *length <= 8)? as u8;
        let mut frame = Self { id, is_extended, is_remote, length, data: [0; 8] };
        let (digits, stamp) = rest.split_at_checked(2 * frame.data().len())?;
        for (byte, at) in frame.data.iter_mut().zip((0..digits.len()).step_by(2)) {
            *byte = hex(digits.get(at..at + 2)?)? as u8;
        }
        let stamp = if stamp.is_empty() { None } else { Some(hex(stamp)?.into()) };
        Some((frame, stamp))
    }
}

impl fmt::Display for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kind = if self.is_remote { 'r' } else { 't' };
        match self.is_extended {
            true => write!(f, "{}{:08X}", kind.to_ascii_uppercase(), self.id)?,
            false => write!(f, "{kind}{:03X}", self.id)?,
        }
        write!(f, "{}", self.length)?;
        self.data().iter().try_for_each(|byte| write!(f, "{byte:02X}"))
    }
}

/// A number of 1 to 8 hexadecimal digits.
pub fn hex(digits: &str) -> Option<u32> {
    let is_hex = digits.bytes().all(|digit| digit.is_ascii_hexdigit());
    is_hex.then(|| u32::from_str_radix(digits, 16).ok())?
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_written_as_they_are_read() {
        let data = |id, is_extended, bytes: &[u8]| Frame::new(id, is_extended, bytes);
        let remote = |id, is_extended, length| Frame {
            is_remote: true,
            length,
            ..data(id, is_extended, &[])
        };
        let cases = [
            ("t7E520401", data(0x7E5, false, &[4, 1])),
            ("t7E50", data(0x7E5, false, &[])),
            (
                "t7E5800112233AABBCCFF",
                data(0x7E5, false, &[0, 0x11, 0x22, 0x33, 0xAA, 0xBB, 0xCC, 0xFF]),
            ),
            ("r7E58", remote(0x7E5, false, 8)),
            ("T123456781FE", data(0x1234_5678, true, &[0xFE])),
            ("R123456780", remote(0x1234_5678, true, 0)),
        ];
        for (line, frame) in cases {
            assert_eq!(frame.to_string(), line);
            assert_eq!(Frame::parse(line), Some((frame, None)));
            let stamped = format!("{}{}ea5f", &line[..1], line[1..].to_lowercase());
            assert_eq!(Frame::parse(&stamped), Some((frame, Some(59_999))));
        }
        for other in [
            "",
            "V",
            "t7E4",
            "t7E42GG",
            "t7E41",
            "t7E4+1+1",
            "tX",
            "t8001AA",
            "T200000000",
            "t7E49",
            "\u{e9}",
        ] {
            assert_eq!(Frame::parse(other), None, "{other:?}");
        }
    }
}
