//! An SDO client: reads and writes of any length (CiA 301, 7.2.4).

mod block;

use std::{fmt, time::Duration};

use crate::{bus::Bus, stop::Stop};

pub use block::{abort, download_blocks};

/// The result of a transfer.
pub type Outcome<T> = Result<Result<T, Error>, Stop>;

/// Why a transfer failed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Error {
    NoAnswer,
    /// The abort code of the server (CiA 301, 7.2.4.3.17).
    Abort(u32),
    /// What else is wrong, in words.
    Other(String),
}

impl Error {
    /// The same without the meaning of a code: `abort 06020000`.
    pub fn short(&self) -> String {
        match self {
            Self::Abort(code) => format!("abort {code:08X}"),
            other => other.to_string(),
        }
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let code = match self {
            Self::NoAnswer => return f.write_str("no answer"),
            Self::Other(words) => return f.write_str(words),
            Self::Abort(code) => *code,
        };
        let meaning = match code {
            0x0601_0000 => "the object does not support this access",
            0x0601_0001 => "the object can only be written",
            0x0601_0002 => "the object can only be read",
            0x0602_0000 => "there is no such object",
            0x0604_0041 => "the object cannot be mapped",
            0x0604_0042 => "the mapped objects are too long for a PDO",
            0x0604_0043 => "the parameters are incompatible",
            0x0606_0000 => "the hardware fails",
            0x0607_0010 | 0x0607_0012 | 0x0607_0013 => "the length is wrong",
            0x0609_0011 => "there is no such sub-index",
            0x0609_0030 => "the value is invalid",
            0x0609_0031 => "the value is too high",
            0x0609_0032 => "the value is too low",
            0x0800_0020 => "it cannot be stored",
            0x0800_0021 | 0x0800_0022 => "not in the present state of the device",
            _ => return f.write_str(&self.short()),
        };
        write!(f, "{meaning} ({})", self.short())
    }
}

/// The command specifier of an abort.
const ABORT: u8 = 0x80;
/// The longest value that is read.
const LONGEST: usize = 1024;

/// Sends a request to the server of `node`; returns its answer if it comes within `wait` and `is_answer`.
fn ask(
    bus: &mut Bus,
    node: u8,
    request: [u8; 8],
    wait: Duration,
    is_answer: impl Fn(&[u8; 8]) -> bool,
) -> Outcome<[u8; 8]> {
    let cob_id = 0x580 + u16::from(node);
    bus.send_to(0x600 + u16::from(node), &request)?;
    let answer = bus.wait_for(wait, |frame| frame.cob_id() == cob_id)?;
    let Some(answer) = answer else { return Ok(Err(Error::NoAnswer)) };
    Ok(match <[u8; 8]>::try_from(answer.frame.data()) {
        Ok(bytes) if bytes[0] != ABORT && is_answer(&bytes) => Ok(bytes),
        _ => Err(error_of(answer.frame.data())),
    })
}

/// The error in an answer that is not the expected one.
fn error_of(answer: &[u8]) -> Error {
    match *answer {
        [ABORT, _, _, _, a, b, c, d] => Error::Abort(u32::from_le_bytes([a, b, c, d])),
        _ => Error::Other(format!("an unexpected answer {answer:02X?}")),
    }
}

/// The request for the value of an object.
pub fn read_request(index: u16, sub_index: u8) -> [u8; 8] {
    let [low, high] = index.to_le_bytes();
    [0x40, low, high, sub_index, 0, 0, 0, 0]
}

/// Reads an object.
pub fn read(bus: &mut Bus, node: u8, index: u16, sub_index: u8) -> Outcome<Vec<u8>> {
    let [low, high] = index.to_le_bytes();
    let wait = bus.patience();
    let is_start = |answer: &[u8; 8]| {
        matches!(answer[0], 0x40..=0x43 | 0x47 | 0x4B | 0x4F)
            && answer[1..4] == [low, high, sub_index]
    };
    let first = match ask(bus, node, read_request(index, sub_index), wait, is_start)? {
        Ok(first) => first,
        Err(why) => return Ok(Err(why)),
    };
    let [command, _, _, _, number @ ..] = first;
    let announced = match command {
        // Segments follow.
        0x40 => None,
        0x41 => Some(u32::from_le_bytes(number) as usize),
        // Expedited, without its length and with it.
        0x42 => return Ok(Ok(number.to_vec())),
        _ => return Ok(Ok(number[..4 - usize::from(command >> 2 & 3)].to_vec())),
    };
    let mut value = Vec::new();
    let mut toggle = 0;
    while value.len() < LONGEST {
        let is_segment = |answer: &[u8; 8]| answer[0] & 0xF0 == toggle;
        let segment = match ask(bus, node, [0x60 | toggle, 0, 0, 0, 0, 0, 0, 0], wait, is_segment)?
        {
            Ok(segment) => segment,
            Err(why) => return Ok(Err(why)),
        };
        let unused = usize::from(segment[0] >> 1 & 7);
        value.extend(&segment[1..8 - unused]);
        if segment[0] & 1 == 1 {
            // A last segment that does not say how many bytes count is as long as announced (CiA 301, 7.2.4.3.4).
            value.truncate(announced.filter(|_| unused == 0).unwrap_or(LONGEST));
            return Ok(Ok(value));
        }
        toggle ^= 0x10;
    }
    Ok(Err(Error::Other(format!("more than {LONGEST} bytes"))))
}

/// Reads a number of one to four bytes.
pub fn read_number(bus: &mut Bus, node: u8, index: u16, sub_index: u8) -> Outcome<u32> {
    Ok(read(bus, node, index, sub_index)?
        .map(|bytes| bytes.iter().rev().fold(0, |number, byte| number << 8 | u32::from(*byte))))
}

/// Writes the lower `len` bytes of `value`, one to four.
pub fn write(bus: &mut Bus, node: u8, object: (u16, u8), value: u32, len: u8) -> Outcome<()> {
    download(bus, node, object, &value.to_le_bytes()[..len.into()], bus.patience())
}

/// Writes a value of any length: up to four bytes expedited, any other in segments. Waits for each answer for `wait`,
/// since a device may store before it answers.
pub fn download(
    bus: &mut Bus,
    node: u8,
    object: (u16, u8),
    data: &[u8],
    wait: Duration,
) -> Outcome<()> {
    download_segments(bus, node, object, data, wait, |_| ())
}

/// The same, and tells `progress` the number of bytes that the server has confirmed.
pub fn download_segments(
    bus: &mut Bus,
    node: u8,
    (index, sub_index): (u16, u8),
    data: &[u8],
    wait: Duration,
    mut progress: impl FnMut(usize),
) -> Outcome<()> {
    let [low, high] = index.to_le_bytes();
    let is_expedited = (1..=4).contains(&data.len());
    let mut request = [0x21, low, high, sub_index, 0, 0, 0, 0];
    if is_expedited {
        request[0] = 0x23 | (4 - data.len() as u8) << 2;
        request[4..][..data.len()].copy_from_slice(data);
    } else {
        request[4..].copy_from_slice(&(data.len() as u32).to_le_bytes());
    }
    if let Err(why) = ask(bus, node, request, wait, |answer| answer[0] == 0x60)? {
        return Ok(Err(why));
    }
    if is_expedited {
        return Ok(Ok(()));
    }
    // An empty value has one segment without data.
    let empty = data.is_empty().then_some(&[][..]);
    let mut segments = data.chunks(7).chain(empty).peekable();
    let (mut toggle, mut done) = (0, 0);
    while let Some(part) = segments.next() {
        let is_last = u8::from(segments.peek().is_none());
        let mut segment = [toggle | (7 - part.len() as u8) << 1 | is_last, 0, 0, 0, 0, 0, 0, 0];
        segment[1..][..part.len()].copy_from_slice(part);
        let is_answer = |answer: &[u8; 8]| answer[0] == 0x20 | toggle;
        if let Err(why) = ask(bus, node, segment, wait, is_answer)? {
            return Ok(Err(why));
        }
        toggle ^= 0x10;
        done += part.len();
        progress(done);
    }
    Ok(Ok(()))
}
