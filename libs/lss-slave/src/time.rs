//! The node's time: a wrapping count of microseconds, and deadlines in it.

use core::num::NonZeroU32;

/// A point in time: microseconds of a free-running 32-bit count that wraps every 71.6 minutes.
///
/// Comparisons assume that two instants are less than half a turn (35.8 minutes) apart. The longest wait of the node is
/// 131.07 s.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Instant(u32);

impl Instant {
    /// The instant at which the count is `micros`.
    pub const fn from_micros(micros: u32) -> Self {
        Self(micros)
    }

    /// The count in microseconds.
    pub const fn as_micros(self) -> u32 {
        self.0
    }

    /// The instant `micros` later.
    #[must_use]
    #[inline]
    pub const fn plus_micros(self, micros: u32) -> Self {
        Self(self.0.wrapping_add(micros))
    }

    /// Microseconds from `now` to this instant; 0 if it has passed.
    #[inline]
    pub const fn micros_after(self, now: Self) -> u32 {
        let ahead = self.0.wrapping_sub(now.0);
        if ahead <= u32::MAX / 2 { ahead } else { 0 }
    }

    /// The earlier of two instants.
    #[must_use]
    #[inline]
    pub const fn earlier(self, other: Self) -> Self {
        if self.has_come(other) { self } else { other }
    }

    /// The earlier of two optional deadlines.
    #[inline(never)] // Inlined, it takes 24 to 116 bytes more.
    pub fn earliest(a: Option<Self>, b: Option<Self>) -> Option<Self> {
        match (a, b) {
            (Some(a), Some(b)) => Some(a.earlier(b)),
            _ => a.or(b),
        }
    }

    /// The later of two instants.
    #[inline]
    pub const fn later(self, other: Self) -> Self {
        if self.has_come(other) { other } else { self }
    }

    /// Whether this instant is after `now`, by at most `micros`. A deadline that nobody has looked at for half a turn of
    /// the count would otherwise lie in the future again.
    #[inline]
    pub const fn is_ahead(self, now: Self, micros: u32) -> bool {
        let ahead = self.micros_after(now);
        0 < ahead && ahead <= micros
    }

    /// Whether this instant is at or before `now`. Only for one that is looked at when it comes, as [`poll_at`] asks for;
    /// any other is a [`Deadline`].
    ///
    /// [`poll_at`]: crate::Slave::poll_at
    #[inline]
    pub const fn has_come(self, now: Self) -> bool {
        self.micros_after(now) == 0
    }
}

/// The end of a wait, with its length: however late somebody looks, it lies in the future for no longer than the wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Deadline {
    end: Instant,
    micros: NonZeroU32,
}

impl Deadline {
    /// The end of a wait of `micros` that begins `now`; `None` if there is nothing to wait for.
    pub fn after(now: Instant, micros: u32) -> Option<Self> {
        Some(Self { end: now.plus_micros(micros), micros: NonZeroU32::new(micros)? })
    }

    /// The end of the wait.
    pub const fn end(self) -> Instant {
        self.end
    }

    /// Whether the wait is over.
    pub const fn is_over(self, now: Instant) -> bool {
        !self.end.is_ahead(now, self.micros.get())
    }
}
