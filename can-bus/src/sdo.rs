//! An SDO client: reads of any length, and writes of up to four bytes (CiA 301, 7.2.4).

use crate::{bus::Bus, stop::Stop};

/// The result of a transfer; an error says in words why it failed.
pub type Outcome<T> = Result<Result<T, String>, Stop>;

/// The longest value that is read.
const LONGEST: usize = 1024;

/// Sends a request to the server of `node`; returns its answer if `is_answer`.
fn ask(
    bus: &mut Bus,
    node: u8,
    request: [u8; 8],
    is_answer: impl Fn(&[u8; 8]) -> bool,
) -> Outcome<[u8; 8]> {
    let cob_id = 0x580 + u16::from(node);
    bus.send_to(0x600 + u16::from(node), &request)?;
    let answer = bus.wait_for(bus.patience(), |frame| frame.cob_id() == cob_id)?;
    let Some(answer) = answer else { return Ok(Err("no answer".into())) };
    Ok(match <[u8; 8]>::try_from(answer.frame.data()) {
        Ok([0x80, _, _, _, a, b, c, d]) => {
            Err(format!("abort {:08X}", u32::from_le_bytes([a, b, c, d])))
        }
        Ok(bytes) if is_answer(&bytes) => Ok(bytes),
        _ => Err(format!("an unexpected answer {:02X?}", answer.frame.data())),
    })
}

/// Reads an object.
pub fn read(bus: &mut Bus, node: u8, index: u16, sub_index: u8) -> Outcome<Vec<u8>> {
    let [low, high] = index.to_le_bytes();
    let is_start = |answer: &[u8; 8]| {
        matches!(answer[0], 0x40..=0x43 | 0x47 | 0x4B | 0x4F)
            && answer[1..4] == [low, high, sub_index]
    };
    let first = match ask(bus, node, [0x40, low, high, sub_index, 0, 0, 0, 0], is_start)? {
        Ok(first) => first,
        Err(why) => return Ok(Err(why)),
    };
    match first[0] {
        // Segments follow.
        0x40 | 0x41 => {}
        // Expedited, without its length and with it.
        0x42 => return Ok(Ok(first[4..].to_vec())),
        command => return Ok(Ok(first[4..8 - usize::from(command >> 2 & 3)].to_vec())),
    }
    let mut value = Vec::new();
    let mut toggle = 0;
    while value.len() < LONGEST {
        let is_segment = |answer: &[u8; 8]| answer[0] & 0xF0 == toggle;
        let segment = match ask(bus, node, [0x60 | toggle, 0, 0, 0, 0, 0, 0, 0], is_segment)? {
            Ok(segment) => segment,
            Err(why) => return Ok(Err(why)),
        };
        value.extend(&segment[1..8 - usize::from(segment[0] >> 1 & 7)]);
        if segment[0] & 1 == 1 {
            return Ok(Ok(value));
        }
        toggle ^= 0x10;
    }
    Ok(Err(format!("more than {LONGEST} bytes")))
}

/// Reads a number of one to four bytes.
pub fn read_number(bus: &mut Bus, node: u8, index: u16, sub_index: u8) -> Outcome<u32> {
    Ok(read(bus, node, index, sub_index)?
        .map(|bytes| bytes.iter().rev().fold(0, |number, byte| number << 8 | u32::from(*byte))))
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
    let request = [0x23 | (4 - len) << 2, low, high, sub_index, a, b, c, d];
    Ok(ask(bus, node, request, |answer| answer[0] == 0x60)?.map(drop))
}
