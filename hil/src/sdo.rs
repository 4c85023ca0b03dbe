//! An SDO client: reads of any length, and writes of up to four bytes (CiA 301, 7.2.4).

use std::fmt;

use crate::{bus::Bus, stop::Stop};

/// The reason why a transfer failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Failure {
    /// The server's abort code.
    Abort(u32),
    NoAnswer,
    /// An answer that does not belong to the request.
    Garbled([u8; 8]),
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Abort(code) => write!(f, "abort {code:08X}"),
            Self::NoAnswer => f.write_str("no answer"),
            Self::Garbled(bytes) => write!(f, "an unexpected answer {bytes:02X?}"),
        }
    }
}

type Outcome<T> = Result<Result<T, Failure>, Stop>;

/// The longest value that is read.
const LONGEST: usize = 1024;

/// Sends a request to the server of `node`; returns its answer.
fn ask(bus: &mut Bus, node: u8, request: [u8; 8]) -> Outcome<[u8; 8]> {
    let cob_id = 0x580 + u16::from(node);
    bus.send_to(0x600 + u16::from(node), &request)?;
    let answer = bus.wait_for(bus.patience(), |frame| frame.cob_id() == cob_id)?;
    Ok(match answer.map(|answer| <[u8; 8]>::try_from(answer.frame.data())) {
        None => Err(Failure::NoAnswer),
        Some(Ok([0x80, _, _, _, a, b, c, d])) => {
            Err(Failure::Abort(u32::from_le_bytes([a, b, c, d])))
        }
        Some(Ok(answer)) => Ok(answer),
        Some(Err(_)) => Err(Failure::Garbled([0; 8])),
    })
}

/// Reads an object.
pub fn read(bus: &mut Bus, node: u8, index: u16, sub_index: u8) -> Outcome<Vec<u8>> {
    let [low, high] = index.to_le_bytes();
    let first = match ask(bus, node, [0x40, low, high, sub_index, 0, 0, 0, 0])? {
        Ok(answer) if answer[1..4] == [low, high, sub_index] => answer,
        Ok(answer) => return Ok(Err(Failure::Garbled(answer))),
        Err(failure) => return Ok(Err(failure)),
    };
    match first[0] {
        // Expedited, with or without its length.
        0x42 => return Ok(Ok(first[4..].to_vec())),
        command if command & !0x0C == 0x43 => {
            let len = 4 - usize::from(command >> 2 & 3);
            return Ok(Ok(first[4..4 + len].to_vec()));
        }
        0x40 | 0x41 => {}
        _ => return Ok(Err(Failure::Garbled(first))),
    }
    let mut value = Vec::new();
    let mut toggle = 0;
    while value.len() < LONGEST {
        let segment = match ask(bus, node, [0x60 | toggle, 0, 0, 0, 0, 0, 0, 0])? {
            Ok(answer) if answer[0] & 0xF0 == toggle => answer,
            Ok(answer) => return Ok(Err(Failure::Garbled(answer))),
            Err(failure) => return Ok(Err(failure)),
        };
        let len = 7 - usize::from(segment[0] >> 1 & 7);
        value.extend(&segment[1..1 + len]);
        if segment[0] & 1 == 1 {
            return Ok(Ok(value));
        }
        toggle ^= 0x10;
    }
    Ok(Err(Failure::Garbled(first)))
}

/// Reads a number of one to four bytes.
pub fn read_number(bus: &mut Bus, node: u8, index: u16, sub_index: u8) -> Outcome<u32> {
    Ok(read(bus, node, index, sub_index)?
        .map(|bytes| bytes.iter().rev().fold(0, |number, byte| number << 8 | u32::from(*byte))))
}

/// Reads a text.
pub fn read_text(bus: &mut Bus, node: u8, index: u16) -> Outcome<String> {
    Ok(read(bus, node, index, 0)?.map(|bytes| String::from_utf8_lossy(&bytes).into_owned()))
}

/// Writes the lower `len` bytes of `value`, one to four.
pub fn write(
    bus: &mut Bus,
    node: u8,
    (index, sub_index): (u16, u8),
    value: u32,
    len: u8,
) -> Outcome<()> {
    let [low, high] = index.to_le_bytes();
    let [a, b, c, d] = value.to_le_bytes();
    let command = 0x23 | (4 - len) << 2;
    Ok(match ask(bus, node, [command, low, high, sub_index, a, b, c, d])? {
        Ok([0x60, ..]) => Ok(()),
        Ok(answer) => Err(Failure::Garbled(answer)),
        Err(failure) => Err(failure),
    })
}
