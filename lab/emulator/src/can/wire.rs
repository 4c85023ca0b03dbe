//! The pair of wires: its level, shorts and noise.

use super::Level;
use crate::Time;

/// A short circuit that silences the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Short {
    /// A supply holds the bus dominant.
    Dominant,
    /// CANH and CANL touch: no station sees a dominant bit, not even its sender.
    Recessive,
}

/// Dominant pulses at pseudo-random instants.
///
/// The gaps between them are evenly distributed from zero to twice their mean.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Noise {
    /// Seed of the random generator: equal seeds give equal instants.
    pub seed: u64,
    /// Mean time from the end of a pulse to the start of the next.
    pub mean_interval: Time,
    pub length: Time,
}

#[derive(Debug, Default)]
pub(super) struct Wire {
    pub level: Level,
    pub short: Option<Short>,
    pulses: Option<Pulses>,
}

#[derive(Debug)]
struct Pulses {
    noise: Noise,
    random: u64,
    dominant: bool,
    /// The end of the current pulse, or the start of the next.
    next: Time,
}

impl Wire {
    /// The level of the wires, given whether any station drives them dominant.
    pub fn resolve(&self, driven: bool) -> Level {
        let pulse = self.pulses.as_ref().is_some_and(|pulses| pulses.dominant);
        match self.short {
            Some(Short::Dominant) => Level::Dominant,
            None if driven || pulse => Level::Dominant,
            None | Some(Short::Recessive) => Level::Recessive,
        }
    }

    pub fn set_noise(&mut self, noise: Option<Noise>, now: Time) {
        self.pulses = noise.map(|noise| Pulses::new(noise, now));
    }

    /// The time at which a pulse starts or ends next.
    pub fn next_action(&self) -> Time {
        self.pulses.as_ref().map_or(Time::MAX, |pulses| pulses.next)
    }

    /// Starts or ends a pulse if that is due; returns whether it did.
    pub fn act(&mut self, now: Time) -> bool {
        let due = self.pulses.as_mut().filter(|pulses| pulses.next <= now);
        due.map(Pulses::toggle).is_some()
    }
}

impl Pulses {
    fn new(noise: Noise, now: Time) -> Self {
        let mut pulses = Self { noise, random: noise.seed, dominant: false, next: now };
        pulses.next = now + pulses.gap();
        pulses
    }

    fn toggle(&mut self) {
        self.dominant = !self.dominant;
        let span = if self.dominant { self.noise.length } else { self.gap() };
        self.next += span;
    }

    /// The length of the next gap, by a step of SplitMix64; never zero.
    fn gap(&mut self) -> Time {
        self.random = self.random.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut mixed = self.random;
        mixed = (mixed ^ mixed >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed = (mixed ^ mixed >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        mixed ^= mixed >> 31;
        let range = 2 * u128::from(self.noise.mean_interval.as_ps());
        Time::from_ps(((u128::from(mixed) * range) >> 64) as u64 + 1)
    }
}
