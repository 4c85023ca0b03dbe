//! Samples of the bus level, for what no event of a controller reports while the bit rate is not proven.

use core::mem;

use super::Sample;
use crate::{BitRate, BusEvent, Instant};

/// The time between samples, and between an error and the next report of one.
const STEP_MICROS: u32 = 1_000;
/// In milliseconds. After a frame at 10 kbit/s the bus is recessive for at least one.
const LONGEST_FRAME: u16 = 16;
const TWO_FRAMES_BITS: u16 = 2 * 135;

/// The samples. Sampling lasts from a start, an error or a [`look`](Self::look) until a valid frame, or until the bus
/// is idle.
#[derive(Debug)]
pub struct Sampler {
    /// The samples, while the controller may be out of sync with the bus.
    samples: Option<Samples>,
    /// The time of the next sample.
    next_at: Option<Instant>,
    /// Whether a frame was received since the last [`look`](Self::look).
    has_understood: bool,
}

/// Samples, one per millisecond, since the controller last received or sent a valid frame.
#[derive(Clone, Copy, Debug, Default)]
struct Samples {
    count: u16,
    is_recessive: bool,
    /// The number of consecutive samples with the latest level.
    equal: u16,
}

impl Sampler {
    /// Without samples.
    pub const fn new() -> Self {
        Self { samples: None, next_at: None, has_understood: false }
    }

    /// Starts sampling.
    pub fn begin(&mut self, now: Instant) {
        self.samples = Some(Samples::default());
        self.next_at.get_or_insert(now.plus_micros(STEP_MICROS));
    }

    /// Notes a received frame.
    pub fn note_frame(&mut self) {
        self.has_understood = true;
        self.samples = None;
    }

    /// Whether sampling should start, as the bus is dominant and no valid frame came since the last call. Must be
    /// called a few times a second.
    pub fn look(&mut self, sample: Sample) -> bool {
        let has_understood = mem::take(&mut self.has_understood);
        !sample.is_recessive && !has_understood && self.samples.is_none()
    }

    /// The time of the next sample.
    pub const fn next_at(&self) -> Option<Instant> {
        self.next_at
    }

    /// Whether the time of the next sample has come.
    pub fn is_due(&mut self, now: Instant) -> bool {
        self.next_at.take_if(|at| at.has_come(now)).is_some()
    }

    /// Takes a sample, and returns an event that the controller does not report.
    pub fn take(&mut self, sample: Sample, bit_rate: BitRate, now: Instant) -> Option<BusEvent> {
        let event = self.judge(sample, bit_rate);
        self.next_at = self.samples.is_some().then(|| now.plus_micros(STEP_MICROS));
        event
    }

    /// Reports a bus that is dominant for longer than the recessive bits of any frame are apart. Also reports traffic
    /// for more than two frame times in which the controller finds neither a frame nor an error. A controller that
    /// waits for a number of equal bits, to join the bus or to end an error flag, may wait for ever at a wrong rate.
    fn judge(&mut self, sample: Sample, bit_rate: BitRate) -> Option<BusEvent> {
        let samples = self.samples.as_mut()?;
        if samples.is_recessive != sample.is_recessive {
            (samples.is_recessive, samples.equal) = (sample.is_recessive, 0);
        }
        samples.equal = samples.equal.saturating_add(1);
        samples.count = samples.count.saturating_add(1);
        if samples.equal >= LONGEST_FRAME {
            samples.count = 0;
            if !sample.is_recessive {
                return Some(BusEvent::HeldDominant);
            }
            self.samples = None;
            return None;
        }
        if sample.is_transmitting {
            samples.count = 0;
        }
        let most = LONGEST_FRAME + 2 + TWO_FRAMES_BITS / bit_rate.kbit_per_s();
        if samples.count <= most {
            return None;
        }
        samples.count = 0;
        Some(BusEvent::Error)
    }
}
