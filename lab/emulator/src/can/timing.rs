//! Bit timing: the parts of a bit in periods of a clock, and the resulting times.

use crate::Time;

/// The clock of a controller: its nominal frequency and the deviation of its crystal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Clock {
    /// Nominal frequency in Hz.
    pub hz: u32,
    /// Deviation in parts per million; positive is fast.
    pub ppm: i32,
}

/// Picoseconds in a second, times the million of "parts per million".
pub(crate) const SCALE: u128 = 1_000_000_000_000_000_000;

impl Clock {
    /// The frequency in millionths of a hertz.
    pub(crate) fn rate(self) -> u128 {
        u128::from(self.hz) * (1_000_000 + i128::from(self.ppm)) as u128
    }
}

/// The parts of a bit (ISO 11898-1, bit timing), besides the synchronisation segment of one quantum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BitSegments {
    /// Clock periods in a time quantum, 1..=1024.
    pub prescaler: u16,
    /// Quanta from the synchronisation segment to the sample point (propagation and phase segment 1), 1..=256.
    pub segment_1: u16,
    /// Quanta from the sample point to the end of the bit, 1..=128.
    pub segment_2: u8,
    /// Resynchronisation jump width in quanta, 1..=128.
    pub jump_width: u8,
}

/// The connection between a controller and the wire.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Mode {
    /// Never drives the wire dominant; without `loopback` it starts no transmission either.
    pub silent: bool,
    /// Receives its own frames instead of the wire's level, and needs no acknowledgement.
    pub loopback: bool,
}

impl BitSegments {
    pub const fn quanta(self) -> u32 {
        1 + self.segment_1 as u32 + self.segment_2 as u32
    }

    /// Nominal bit rate in bit/s on a clock of `hz`, rounded down.
    pub const fn bit_rate(self, hz: u32) -> u32 {
        hz / (self.prescaler as u32 * self.quanta())
    }
}

/// The times of a bit on a real clock, each rounded to the picosecond so that errors do not accumulate over quanta.
#[derive(Clone, Copy, Debug)]
pub(super) struct Spans {
    /// A time quantum in picoseconds.
    pub quantum: u64,
    /// The time from the start of the bit to its sample point.
    pub sample: Time,
    pub bit: Time,
    /// Resynchronisation jump width in quanta.
    pub jump_width: i64,
}

impl Spans {
    pub fn new(clock: Clock, timing: BitSegments) -> Self {
        let span = |quanta: u32| {
            let periods = u128::from(u32::from(timing.prescaler) * quanta);
            ((periods * SCALE + clock.rate() / 2) / clock.rate()) as u64
        };
        Self {
            quantum: span(1),
            sample: Time::from_ps(span(1 + u32::from(timing.segment_1))),
            bit: Time::from_ps(span(timing.quanta())),
            jump_width: i64::from(timing.jump_width),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TIMING: BitSegments =
        BitSegments { prescaler: 2, segment_1: 13, segment_2: 2, jump_width: 1 };

    #[test]
    fn a_fast_crystal_shortens_the_bit_by_its_deviation() {
        let bit = |ppm| Spans::new(Clock { hz: 32_000_000, ppm }, TIMING).bit.as_ps();
        assert_eq!(bit(1), 999_999);
        assert_eq!(bit(-1), 1_000_001);
        assert_eq!(bit(5_000), 995_025);
    }
}
