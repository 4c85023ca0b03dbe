//! Virtual time: one type for instants and durations, counted in picoseconds.

use core::{
    fmt,
    ops::{Add, AddAssign, Mul, Sub},
};

/// An instant since the start of the run, or a duration: picoseconds, up to 213 days.
///
/// Picoseconds represent every time quantum of an STM32F4 precisely enough that a run of bits does not drift.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Time(u64);

impl Time {
    /// The start of the run, or a duration of zero.
    pub const ZERO: Self = Self(0);
    /// An instant later than all others.
    pub const MAX: Self = Self(u64::MAX);

    pub const fn from_ps(ps: u64) -> Self {
        Self(ps)
    }
    pub const fn from_ns(ns: u64) -> Self {
        Self(ns * 1_000)
    }
    pub const fn from_us(us: u64) -> Self {
        Self(us * 1_000_000)
    }
    pub const fn from_ms(ms: u64) -> Self {
        Self(ms * 1_000_000_000)
    }
    pub const fn from_s(s: u64) -> Self {
        Self(s * 1_000_000_000_000)
    }
    pub const fn as_ps(self) -> u64 {
        self.0
    }
    /// Whole nanoseconds, rounded down.
    pub const fn as_ns(self) -> u64 {
        self.0 / 1_000
    }
    /// Whole microseconds, rounded down.
    pub const fn as_us(self) -> u64 {
        self.0 / 1_000_000
    }
    /// Whole milliseconds, rounded down.
    pub const fn as_ms(self) -> u64 {
        self.0 / 1_000_000_000
    }
    /// `self - earlier`, or zero if `earlier` is later.
    pub const fn saturating_sub(self, earlier: Self) -> Self {
        Self(self.0.saturating_sub(earlier.0))
    }
}

impl Add for Time {
    type Output = Self;
    fn add(self, span: Self) -> Self {
        Self(self.0 + span.0)
    }
}

impl AddAssign for Time {
    fn add_assign(&mut self, span: Self) {
        self.0 += span.0;
    }
}

impl Sub for Time {
    type Output = Self;
    fn sub(self, earlier: Self) -> Self {
        Self(self.0 - earlier.0)
    }
}

impl Mul<u64> for Time {
    type Output = Self;
    fn mul(self, factor: u64) -> Self {
        Self(self.0 * factor)
    }
}

/// Milliseconds with six decimals: `12.345678`.
impl fmt::Display for Time {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ns = self.as_ns();
        f.pad(&format!("{}.{:06}", ns / 1_000_000, ns % 1_000_000))
    }
}
