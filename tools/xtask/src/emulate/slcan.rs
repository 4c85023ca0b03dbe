//! The SLCAN protocol of serial CAN adapters (LAWICEL CANUSB): commands and answers as lines of ASCII.

use emulator::can::{Frame, Id, fault::ErrorCounters};

/// The end of a command, and of a positive answer.
pub const END: u8 = b'\r';
/// The answer to a command that is unknown or cannot be carried out now.
pub const REFUSED: &[u8] = b"\x07";

/// The bit rates of `S0`..`S8`, in bit/s.
const BIT_RATES: [u32; 9] =
    [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000];
/// Timestamps count milliseconds and wrap to zero at this value.
const TIMESTAMP_RANGE: u64 = 60_000;

/// A command of the connected program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// An empty line, of which some programs send a few to end any earlier line; or `M`, `m`, the acceptance filter of
    /// an SJA1000.
    Nothing,
    /// `S`: the bit rate, in bit/s.
    BitRate(u32),
    /// `O`.
    Open,
    /// `L`: open, but never drive the bus.
    ListenOnly,
    /// `C`.
    Close,
    /// `t`, `T`, `r`, `R`.
    Transmit(Frame),
    /// `V`.
    Version,
    /// `N`.
    SerialNumber,
    /// `F`: the flags of [`status`].
    Status,
    /// `Z`: whether received frames carry a timestamp.
    Timestamps(bool),
}

impl Command {
    /// Parses a line, without the carriage return; `None` if it is not a command.
    pub fn parse(line: &[u8]) -> Option<Self> {
        let line = str::from_utf8(line).ok().filter(|line| line.is_ascii())?;
        let Some(command) = line.chars().next() else {
            return Some(Self::Nothing);
        };
        let argument = &line[1..];
        Some(match (command, argument) {
            ('S', _) => Self::BitRate(*BIT_RATES.get(hex(argument, 1)? as usize)?),
            ('O', "") => Self::Open,
            ('L', "") => Self::ListenOnly,
            ('C', "") => Self::Close,
            ('V', "") => Self::Version,
            ('N', "") => Self::SerialNumber,
            ('F', "") => Self::Status,
            ('Z', "0") => Self::Timestamps(false),
            ('Z', "1") => Self::Timestamps(true),
            ('M' | 'm', _) => hex(argument, 8).map(|_| Self::Nothing)?,
            ('t' | 'r', _) => {
                let (id, rest) = argument.split_at_checked(3)?;
                let id = u16::try_from(hex(id, 3)?).ok().filter(|id| *id <= 0x7FF)?;
                Self::Transmit(frame(Id::Standard(id), command == 'r', rest)?)
            }
            ('T' | 'R', _) => {
                let (id, rest) = argument.split_at_checked(8)?;
                let id = hex(id, 8).filter(|id| *id <= 0x1FFF_FFFF)?;
                Self::Transmit(frame(Id::Extended(id), command == 'R', rest)?)
            }
            _ => return None,
        })
    }
}

/// Parses a number of exactly `count` hexadecimal digits.
fn hex(digits: &str, count: usize) -> Option<u32> {
    let is_hex = digits.len() == count && digits.bytes().all(|digit| digit.is_ascii_hexdigit());
    is_hex.then(|| u32::from_str_radix(digits, 16).ok()).flatten()
}

/// Parses a frame from its data length code and data.
fn frame(id: Id, is_remote: bool, rest: &str) -> Option<Frame> {
    let (dlc, digits) = rest.split_at_checked(1)?;
    let dlc = hex(dlc, 1).filter(|dlc| *dlc <= 8)? as u8;
    if is_remote {
        return digits.is_empty().then(|| Frame::remote(id, dlc));
    }
    if digits.len() != 2 * usize::from(dlc) {
        return None;
    }
    let mut data = [0; 8];
    for (byte, at) in data.iter_mut().zip((0..digits.len()).step_by(2)) {
        *byte = hex(&digits[at..at + 2], 2)? as u8;
    }
    Some(Frame::data(id, &data[..usize::from(dlc)]))
}

/// The line for a received frame, including its end; `milliseconds` is the time of reception if timestamps are on.
pub fn received(frame: &Frame, milliseconds: Option<u64>) -> String {
    let (command, id) = match (frame.id, frame.remote) {
        (Id::Standard(id), false) => ('t', format!("{id:03X}")),
        (Id::Standard(id), true) => ('r', format!("{id:03X}")),
        (Id::Extended(id), false) => ('T', format!("{id:08X}")),
        (Id::Extended(id), true) => ('R', format!("{id:08X}")),
    };
    let mut line = format!("{command}{id}{}", frame.dlc.min(8));
    for byte in frame.payload() {
        line += &format!("{byte:02X}");
    }
    if let Some(milliseconds) = milliseconds {
        line += &format!("{:04X}", milliseconds % TIMESTAMP_RANGE);
    }
    line.push(char::from(END));
    line
}

/// The answer to [`Command::Transmit`]: the frame waits for the bus.
pub const fn queued(frame: &Frame) -> &'static [u8] {
    match frame.id {
        Id::Standard(_) => b"z\r",
        Id::Extended(_) => b"Z\r",
    }
}

/// The answer to [`Command::Status`]: flags of the error counters, and whether errors were found since it was asked last.
pub fn status(counters: ErrorCounters, has_errors: bool) -> String {
    let (warning, passive) = (counters.warning(), counters.passive());
    let flags = u8::from(warning) << 2 | u8::from(passive) << 5 | u8::from(has_errors) << 7;
    format!("F{flags:02X}\r")
}

#[cfg(test)]
mod tests {
    use super::*;

    const STANDARD: Id = Id::Standard(0x7E5);
    const EXTENDED: Id = Id::Extended(0x1234_5678);

    #[test]
    fn frames_are_written_as_they_are_read() {
        let cases = [
            ("t7E52" /* id, length */, "0401", Frame::data(STANDARD, &[4, 1])),
            ("t7E50", "", Frame::data(STANDARD, &[])),
            ("t7E58", "00112233AABBCCFF", {
                Frame::data(STANDARD, &[0, 0x11, 0x22, 0x33, 0xAA, 0xBB, 0xCC, 0xFF])
            }),
            ("r7E58", "", Frame::remote(STANDARD, 8)),
            ("T123456781", "FE", Frame::data(EXTENDED, &[0xFE])),
            ("R123456780", "", Frame::remote(EXTENDED, 0)),
        ];
        for (head, data, frame) in cases {
            let line = format!("{head}{data}");
            assert_eq!(Command::parse(line.as_bytes()), Some(Command::Transmit(frame)));
            let lower_case = format!("{head}{}", data.to_lowercase());
            assert_eq!(Command::parse(lower_case.as_bytes()), Some(Command::Transmit(frame)));
            assert_eq!(received(&frame, None), line.clone() + "\r");
            assert_eq!(received(&frame, Some(60_255)), line + "00FF\r");
        }
    }

    #[test]
    fn a_data_length_code_above_eight_is_reported_as_eight() {
        let frame = Frame::data(STANDARD, &[0; 8]).with_dlc(15);
        assert_eq!(received(&frame, None), "t7E580000000000000000\r");
    }
}
