//! The COB-IDs that a node receives.

use core::{array, iter};

use crate::{count::Count, numbers::Numbers};

/// The COB-IDs of the frames that a node uses. An unused place repeats the COB-ID of LSS requests, 7E5h.
#[derive(Clone, Copy, Debug)]
pub struct Receives<N: Numbers = Count<0, 0, 0>> {
    /// The node looks at every frame, since its bit rate is not proven.
    pub all: bool,
    /// LSS requests, NMT commands, SDO requests and SYNC.
    pub services: [u16; 4],
    /// The RPDOs.
    pub rpdos: N::Rpdos<u16>,
    /// The heartbeats that are watched.
    pub heartbeats: N::Producers<u16>,
}

impl<N: Numbers> Receives<N> {
    /// The COB-IDs of the node's own frames; some may be equal.
    pub fn iter(&self) -> impl Iterator<Item = u16> {
        let others = self.rpdos.as_ref().iter().chain(self.heartbeats.as_ref());
        self.services.iter().chain(others).copied()
    }

    /// The same in lists of `LEN`, for filters with that many places; an unused place repeats the first of its list.
    pub fn lists<const LEN: usize>(&self) -> impl Iterator<Item = [u16; LEN]> {
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

impl<N: Numbers> PartialEq for Receives<N> {
    fn eq(&self, other: &Self) -> bool {
        self.all == other.all
            && self.services == other.services
            && self.rpdos.as_ref() == other.rpdos.as_ref()
            && self.heartbeats.as_ref() == other.heartbeats.as_ref()
    }
}

impl<N: Numbers> Eq for Receives<N> {}

#[cfg(feature = "defmt")]
impl<N: Numbers> defmt::Format for Receives<N> {
    fn format(&self, to: defmt::Formatter<'_>) {
        let (rpdos, heartbeats) = (self.rpdos.as_ref(), self.heartbeats.as_ref());
        defmt::write!(to, "{=bool} {} {} {}", self.all, self.services, rpdos, heartbeats);
    }
}
