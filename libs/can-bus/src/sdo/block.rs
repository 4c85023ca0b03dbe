//! Block download (CiA 301, 7.2.4.3.9 to 7.2.4.3.11): many segments for one answer.

use std::time::{Duration, Instant};

use canopen_node::Frame;

use super::{Error, Outcome, ask, error_of};
use crate::{
    bus::{Bus, bits},
    stop::Stop,
};

/// The bit of the last segment of all.
const LAST: u8 = 0x80;
/// The bits of a segment on the bus, with as many stuff bits as there can be.
const SEGMENT_BITS: u32 = 135;
/// The number of segments that may wait in the adapter, whose queue is short.
const AHEAD: u32 = 8;
/// How often the segments that were lost are sent again.
const REPEATS: usize = 5;

/// Writes a value by block transfer, with a check by CRC if the server has one. Tells `progress` the number of bytes that
/// the server has confirmed. Waits for the first and the last answer for `wait`.
pub fn download_blocks(
    bus: &mut Bus,
    node: u8,
    (index, sub_index): (u16, u8),
    data: &[u8],
    wait: Duration,
    mut progress: impl FnMut(usize),
) -> Outcome<()> {
    let [low, high] = index.to_le_bytes();
    let [a, b, c, d] = (data.len() as u32).to_le_bytes();
    let is_begin = |answer: &[u8; 8]| answer[0] & !0x04 == 0xA0 && is_size(answer[4]);
    let begin = [0xC6, low, high, sub_index, a, b, c, d];
    let answer = match ask(bus, node, begin, wait, is_begin)? {
        Ok(answer) => answer,
        Err(why) => return Ok(Err(why)),
    };
    let has_crc = answer[0] & 0x04 != 0;
    let mut size = answer[4];
    let segments: Vec<&[u8]> = data.chunks(7).collect();
    let (mut done, mut repeats) = (0, 0);
    while done < segments.len() {
        let rest = &segments[done..];
        let count = rest.len().min(size.into());
        let (acknowledged, next) = match send_block(bus, node, &rest[..count], count == rest.len())?
        {
            Ok(answer) => answer,
            Err(why) => return Ok(Err(why)),
        };
        repeats += usize::from(usize::from(acknowledged) < count);
        if repeats > REPEATS {
            return Ok(Err(Error::Other("segments are lost again and again".into())));
        }
        size = next;
        done += usize::from(acknowledged).min(count);
        progress(data.len().min(7 * done));
    }
    let unused = 7 * segments.len() - data.len();
    let [c0, c1] = if has_crc { crc(data).to_le_bytes() } else { [0; 2] };
    let end = [0xC1 | (unused as u8) << 2, c0, c1, 0, 0, 0, 0, 0];
    Ok(ask(bus, node, end, wait, |answer| answer[0] == 0xA1)?.map(drop))
}

/// Sends the segments of a block; returns how many of them the server acknowledges, and the size of the next block.
fn send_block(bus: &mut Bus, node: u8, segments: &[&[u8]], ends: bool) -> Outcome<(u8, u8)> {
    let cob_id = 0x580 + u16::from(node);
    let is_answer = |frame: &Frame| frame.cob_id() == cob_id;
    let begin = bus.time();
    let mut last = [0; 8];
    let mut answer = None;
    for (number, segment) in (1..).zip(segments) {
        let is_last = ends && usize::from(number) == segments.len();
        last = [number | if is_last { LAST } else { 0 }, 0, 0, 0, 0, 0, 0, 0];
        last[1..][..segment.len()].copy_from_slice(segment);
        bus.send_to(0x600 + u16::from(node), &last)?;
        let ahead = u32::from(number).saturating_sub(AHEAD);
        answer =
            bus.wait_for(until(bus, begin + bits(ahead * SEGMENT_BITS, bus.rate())), is_answer)?;
        // It has refused one of them.
        if answer.is_some() {
            break;
        }
    }
    let patience = bus.patience() + bits(AHEAD * SEGMENT_BITS, bus.rate());
    if answer.is_none() {
        answer = bus.wait_for(patience, is_answer)?;
    }
    if answer.is_none() {
        // It does not answer if the last segment was lost.
        bus.send_to(0x600 + u16::from(node), &last)?;
        answer = bus.wait_for(patience, is_answer)?;
    }
    let Some(answer) = answer else { return Ok(Err(Error::NoAnswer)) };
    Ok(match *answer.frame.data() {
        [0xA2, acknowledged, size, ..] if is_size(size) => Ok((acknowledged, size)),
        ref data => Err(error_of(data)),
    })
}

/// The time until `at`.
fn until(bus: &Bus, at: Instant) -> Duration {
    at.saturating_duration_since(bus.time())
}

/// Whether a block may have so many segments.
fn is_size(size: u8) -> bool {
    (1..=127).contains(&size)
}

/// Ends a transfer that the server still expects something of.
pub fn abort(bus: &mut Bus, node: u8, (index, sub_index): (u16, u8)) -> Result<(), Stop> {
    let [low, high] = index.to_le_bytes();
    let [a, b, c, d] = 0x0800_0000_u32.to_le_bytes();
    bus.send_to(0x600 + u16::from(node), &[0x80, low, high, sub_index, a, b, c, d])
}

/// CRC-16-CCITT (CiA 301, 7.2.4.3.16).
fn crc(data: &[u8]) -> u16 {
    data.iter().fold(0, |crc: u16, byte| {
        (0..8).fold(crc ^ u16::from(*byte) << 8, |crc, _| {
            if crc >> 15 == 1 { crc << 1 ^ 0x1021 } else { crc << 1 }
        })
    })
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_crc_of_the_example_in_cia_301_is_31c3() {
        assert_eq!(super::crc(b"123456789"), 0x31C3);
    }
}
