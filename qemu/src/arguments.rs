//! The plugin's arguments on QEMU's command line.

use std::str::FromStr;

use emulator::{
    Time,
    can::{Frame, Id},
};

/// The chip's unique id, and the adapter's session.
pub struct Arguments {
    pub bit_rate: u32,
    pub unique_id: [u8; 12],
    /// The time at which the first frame is queued.
    pub start: Time,
    /// The time from one frame to the next, and from the last to the end.
    pub interval: Time,
    pub frames: Vec<Frame>,
}

impl Arguments {
    /// Parses `key=value` strings.
    ///
    /// # Errors
    /// The first argument that is invalid.
    pub fn parse<'a>(arguments: impl Iterator<Item = &'a str>) -> Result<Self, String> {
        let mut parsed = Self {
            bit_rate: 125_000,
            unique_id: [0; 12],
            start: Time::from_s(1),
            interval: Time::from_ms(50),
            frames: Vec::new(),
        };
        for argument in arguments {
            let (key, value) = argument.split_once('=').unwrap_or((argument, ""));
            let understood = match key {
                "bit-rate" => set(&mut parsed.bit_rate, value.parse().ok()),
                "unique-id" => {
                    set(&mut parsed.unique_id, hex(value).and_then(|id| id.try_into().ok()))
                }
                "start" => set(&mut parsed.start, milliseconds(value)),
                "interval" => set(&mut parsed.interval, milliseconds(value)),
                "send" => frame(value).map(|frame| parsed.frames.push(frame)),
                _ => None,
            };
            understood.ok_or_else(|| format!("`{argument}` is not understood"))?;
        }
        Ok(parsed)
    }
}

fn set<T>(place: &mut T, value: Option<T>) -> Option<()> {
    *place = value?;
    Some(())
}

fn milliseconds(text: &str) -> Option<Time> {
    u32::from_str(text).ok().map(|ms| Time::from_ms(ms.into()))
}

/// A data frame with an 11-bit identifier in the notation of candump.
fn frame(text: &str) -> Option<Frame> {
    let (id, data) = text.split_once('#')?;
    let id = u16::from_str_radix(id, 16).ok().filter(|id| *id <= 0x7FF)?;
    let data = hex(data).filter(|data| data.len() <= 8)?;
    Some(Frame::data(Id::Standard(id), &data))
}

fn hex(text: &str) -> Option<Vec<u8>> {
    let digits = text.as_bytes();
    let byte = |pair: &[u8]| u8::from_str_radix(str::from_utf8(pair).ok()?, 16).ok();
    digits.len().is_multiple_of(2).then(|| digits.chunks(2).map(byte).collect())?
}
