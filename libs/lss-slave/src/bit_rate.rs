//! The bit rates of CiA 301 and their table for LSS; below it, the bit timing for each, the switch to another, and the
//! supervision.

mod control;
mod event;
mod supervision;
mod timing;

use core::fmt;

pub use control::Control;
pub(crate) use control::Next;
pub use event::BusEvent;
pub(crate) use supervision::Step;
pub use timing::BitTiming;

/// A bit rate of CiA 301; the value is its index in the table that configure bit timing selects with 0 (CiA 305).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
#[expect(missing_docs, reason = "the names say it")]
pub enum BitRate {
    Kbit1000 = 0,
    Kbit800 = 1,
    Kbit500 = 2,
    Kbit250 = 3,
    Kbit125 = 4,
    Kbit50 = 6,
    Kbit20 = 7,
    Kbit10 = 8,
}

impl BitRate {
    /// All bit rates, the fastest first.
    pub const ALL: [Self; 8] = [
        Self::Kbit1000,
        Self::Kbit800,
        Self::Kbit500,
        Self::Kbit250,
        Self::Kbit125,
        Self::Kbit50,
        Self::Kbit20,
        Self::Kbit10,
    ];

    /// The rate at `index` of table `table`: table 0, index 0..=4 and 6..=8. Index 5 is reserved; some old texts assign
    /// 100 kbit/s to it.
    pub const fn from_table(table: u8, index: u8) -> Option<Self> {
        match (table, index) {
            (0, 0) => Some(Self::Kbit1000),
            (0, 1) => Some(Self::Kbit800),
            (0, 2) => Some(Self::Kbit500),
            (0, 3) => Some(Self::Kbit250),
            (0, 4) => Some(Self::Kbit125),
            (0, 6) => Some(Self::Kbit50),
            (0, 7) => Some(Self::Kbit20),
            (0, 8) => Some(Self::Kbit10),
            _ => None,
        }
    }

    /// The rate of so many kbit/s.
    pub fn from_kbit_per_s(kbit_per_s: u16) -> Option<Self> {
        Self::ALL.into_iter().find(|rate| rate.kbit_per_s() == kbit_per_s)
    }

    /// The index in table 0.
    pub const fn index(self) -> u8 {
        self as u8
    }

    /// The rate in kbit/s.
    pub const fn kbit_per_s(self) -> u16 {
        // A lookup by index, which includes the old value of the reserved index: a `match` would put a table into each
        // caller.
        const TABLE: [u16; 9] = [1000, 800, 500, 250, 125, 100, 50, 20, 10];
        TABLE[self as usize]
    }
}

/// `125 kbit/s`.
impl fmt::Display for BitRate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} kbit/s", self.kbit_per_s())
    }
}

/// A selection from table 0 of configure bit timing (CiA 305): a bit rate or automatic detection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum BitRateSetting {
    /// Index 0..=4, 6..=8.
    Fixed(BitRate),
    /// Index 9: automatic bit-rate detection.
    Automatic,
}

impl BitRateSetting {
    const AUTOMATIC_INDEX: u8 = 9;

    /// The setting at `index` of table `table`.
    pub const fn from_table(table: u8, index: u8) -> Option<Self> {
        match (table, index) {
            (0, Self::AUTOMATIC_INDEX) => Some(Self::Automatic),
            _ => match BitRate::from_table(table, index) {
                Some(rate) => Some(Self::Fixed(rate)),
                None => None,
            },
        }
    }

    /// The index in table 0.
    pub const fn index(self) -> u8 {
        match self {
            Self::Fixed(rate) => rate.index(),
            Self::Automatic => Self::AUTOMATIC_INDEX,
        }
    }
}

/// `125 kbit/s` or `automatic`.
impl fmt::Display for BitRateSetting {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Fixed(rate) => write!(f, "{rate}"),
            Self::Automatic => f.write_str("automatic"),
        }
    }
}

impl From<BitRate> for BitRateSetting {
    fn from(rate: BitRate) -> Self {
        Self::Fixed(rate)
    }
}

/// A set of bit rate settings that a device offers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct BitRates(u16);

impl BitRates {
    /// The rates that a controller with a clock of `clock_hz` can produce, see [`BitTiming::solve`].
    pub const fn possible(clock_hz: u32) -> Self {
        let mut rates = 0;
        let mut i = 0;
        while i < BitRate::ALL.len() {
            if BitTiming::solve(BitRate::ALL[i], clock_hz).is_some() {
                rates |= 1 << BitRate::ALL[i].index();
            }
            i += 1;
        }
        Self(rates)
    }

    /// One rate: configure bit timing parameters refuses all others.
    pub const fn only(rate: BitRate) -> Self {
        Self(1 << rate.index())
    }

    /// The same rates and automatic detection.
    #[must_use]
    pub const fn with_automatic(self) -> Self {
        Self(self.0 | 1 << BitRateSetting::AUTOMATIC_INDEX)
    }

    /// The same rates except this one, which a transceiver or a long bus may not allow.
    #[must_use]
    pub const fn without(self, rate: BitRate) -> Self {
        Self(self.0 & !(1 << rate.index()))
    }

    /// The fastest rate of the set; 10 kbit/s if the set is empty.
    pub const fn fastest(self) -> BitRate {
        let mut fastest = BitRate::Kbit10;
        let mut i = BitRate::ALL.len();
        while i > 0 {
            i -= 1;
            if self.contains(BitRate::ALL[i]) {
                fastest = BitRate::ALL[i];
            }
        }
        fastest
    }

    /// Whether the set contains `rate`.
    pub const fn contains(self, rate: BitRate) -> bool {
        self.offers(BitRateSetting::Fixed(rate))
    }

    /// The setting, or automatic detection in place of a rate that is not in the set: a program with another clock may
    /// have stored it.
    pub const fn or_automatic(self, setting: BitRateSetting) -> BitRateSetting {
        if self.offers(setting) { setting } else { BitRateSetting::Automatic }
    }

    /// Whether the set contains `setting`.
    pub const fn offers(self, setting: BitRateSetting) -> bool {
        self.0 >> setting.index() & 1 == 1
    }
}
