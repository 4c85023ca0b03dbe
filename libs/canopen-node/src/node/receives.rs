//! The COB-IDs that a node receives.

use core::{array, iter};

/// The COB-IDs of the frames that a node uses. An unused place repeats the COB-ID of LSS requests, 7E5h.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Receives<const RPDOS: usize = 0, const PRODUCERS: usize = 0> {
    /// The node looks at every frame, since its bit rate is not proven.
    pub all: bool,
    /// LSS requests, NMT commands, SDO requests and SYNC.
    pub services: [u16; 4],
    /// The RPDOs.
    pub rpdos: [u16; RPDOS],
    /// The heartbeats that are watched.
    pub heartbeats: [u16; PRODUCERS],
}

impl<const RPDOS: usize, const PRODUCERS: usize> Receives<RPDOS, PRODUCERS> {
    /// The COB-IDs of the node's own frames; some may be equal.
    pub fn iter(&self) -> impl Iterator<Item = u16> {
        let others = self.rpdos.iter().chain(&self.heartbeats);
        self.services.iter().chain(others).copied()
    }

    /// The same in lists of `N`, for filters with that many places; an unused place repeats the first of its list.
    pub fn lists<const N: usize>(&self) -> impl Iterator<Item = [u16; N]> {
        let mut cob_ids = self.iter();
        iter::from_fn(move || {
            let first = cob_ids.next()?;
            Some(array::from_fn(|at| match at {
                0 => first,
                _ => cob_ids.next().unwrap_or(first),
            }))
        })
    }

    /// Whether the node uses frames of this COB-ID: for a controller without filters.
    pub fn contains(&self, cob_id: u16) -> bool {
        self.all || self.iter().any(|used| used == cob_id)
    }
}
