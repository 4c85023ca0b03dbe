//! The bit rates of CiA 301, their table for LSS, and the solver for the bit timing at a given clock.

use core::fmt;

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
            Self::Fixed(rate) => write!(f, "{} kbit/s", rate.kbit_per_s()),
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

    /// The same rates and automatic detection.
    #[must_use]
    pub const fn with_automatic(self) -> Self {
        Self(self.0 | 1 << BitRateSetting::AUTOMATIC_INDEX)
    }

    /// The fastest rate of the set; 10 kbit/s if the set is empty.
    pub(crate) const fn fastest(self) -> BitRate {
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

    /// Whether the set contains `setting`.
    pub const fn offers(self, setting: BitRateSetting) -> bool {
        self.0 >> setting.index() & 1 == 1
    }
}

/// Bit timing (ISO 11898-1): prescaler and segments, in time quanta. The ranges are those of a bxCAN and of most other
/// controllers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct BitTiming {
    /// Cycles of the controller's clock per time quantum: 1..=1024.
    pub prescaler: u16,
    /// Time quanta from the synchronisation quantum to the sample point: 1..=16.
    pub segment1: u8,
    /// Time quanta after the sample point: 1..=8.
    pub segment2: u8,
    /// Time quanta by which a resynchronisation may move the sample point: 1..=4.
    pub sync_jump_width: u8,
}

impl BitTiming {
    /// The largest rate error: 1/1000, which leaves most of the tolerance of a CAN bit to the crystals.
    pub const MAX_RATE_ERROR_PPM: u32 = 1_000;
    /// The crystal error to tolerate in each of two nodes, if the clock allows it: 1/200.
    pub const CRYSTAL_ERROR_PPM: u32 = 5_000;
    /// The preferred sample point, in 1/1000 of the bit (CiA 301).
    pub const SAMPLE_POINT: u32 = 875;
    /// Time quanta per bit (ISO 11898-1).
    const QUANTA: core::ops::RangeInclusive<u32> = 8..=25;

    /// The range of the sample point that CiA 301 allows at `rate`, in 1/1000 of the bit: 750..=900 at 1000 and
    /// 800 kbit/s, 850..=900 below.
    pub const fn sample_point_range(rate: BitRate) -> core::ops::RangeInclusive<u32> {
        match rate {
            BitRate::Kbit1000 | BitRate::Kbit800 => 750..=900,
            _ => 850..=900,
        }
    }

    /// The best bit timing for `rate` at a controller clock of `clock_hz`. The criteria, in this order: the least rate
    /// error; a [`crystal_tolerance_ppm`](Self::crystal_tolerance_ppm) of
    /// [`CRYSTAL_ERROR_PPM`](Self::CRYSTAL_ERROR_PPM) or as near as possible; the sample point nearest to 87.5 %, the
    /// earlier of two; the most time quanta. The synchronisation jump width is as large as the second segment allows.
    ///
    /// `None` if the rate would be more than 0.1 % off or the sample point outside of
    /// [`sample_point_range`](Self::sample_point_range).
    pub const fn solve(rate: BitRate, clock_hz: u32) -> Option<Self> {
        let bit_hz = rate.kbit_per_s() as u64 * 1000;
        let sample_points = Self::sample_point_range(rate);
        let mut best = None;
        let mut best_rank = Rank::WORST;
        // The first of equal ranks is kept: it has the most quanta and, at equal distance from 87.5 %, the earlier
        // sample point.
        let mut quanta = *Self::QUANTA.end();
        while quanta >= *Self::QUANTA.start() {
            let quantum_hz = bit_hz * quanta as u64;
            let prescaler = (clock_hz as u64 + quantum_hz / 2) / quantum_hz;
            let error_hz = (clock_hz as u64).abs_diff(quantum_hz * prescaler);
            let error_ppm = error_hz * 1_000_000 / quantum_hz;
            let rate_fits = prescaler >= 1
                && prescaler <= 1024
                && error_hz * 1_000_000 <= Self::MAX_RATE_ERROR_PPM as u64 * quantum_hz * prescaler;
            let mut segment2 = 8;
            while rate_fits && segment2 >= 1 {
                let segment1 = (quanta - 1).saturating_sub(segment2);
                let timing = Self {
                    prescaler: prescaler as u16,
                    segment1: segment1 as u8,
                    segment2: segment2 as u8,
                    sync_jump_width: if segment2 < 4 { segment2 as u8 } else { 4 },
                };
                let intolerance =
                    Self::CRYSTAL_ERROR_PPM.saturating_sub(timing.crystal_tolerance_ppm());
                let sample_point = timing.sample_point();
                let rank = Rank {
                    rate_error_ppm: error_ppm / prescaler,
                    intolerance_ppm: intolerance,
                    sample_point_error: sample_point.abs_diff(Self::SAMPLE_POINT),
                };
                if segment1 >= 1
                    && segment1 <= 16
                    && sample_point >= *sample_points.start()
                    && sample_point <= *sample_points.end()
                    && rank.is_better_than(&best_rank)
                {
                    best_rank = rank;
                    best = Some(timing);
                }
                segment2 -= 1;
            }
            quanta -= 1;
        }
        best
    }

    /// The crystal error that two nodes on a short bus tolerate, in opposite directions and in ppm. A resynchronisation
    /// corrects the drift of 10 bits, and the drift of the 13 bits that an error flag can last does not pass the sample
    /// point (ISO 11898-1).
    pub const fn crystal_tolerance_ppm(self) -> u32 {
        let quanta = self.quanta();
        let shorter =
            if self.segment1 < self.segment2 { self.segment1 } else { self.segment2 } as u32;
        let jump = self.sync_jump_width as u32 * 1_000_000 / (20 * quanta);
        let phase = shorter * 1_000_000 / (2 * (13 * quanta - self.segment2 as u32));
        if jump < phase { jump } else { phase }
    }

    /// Time quanta per bit.
    pub const fn quanta(self) -> u32 {
        1 + self.segment1 as u32 + self.segment2 as u32
    }

    /// The sample point, in 1/1000 of the bit.
    pub const fn sample_point(self) -> u32 {
        (1 + self.segment1 as u32) * 1000 / self.quanta()
    }

    /// The bit rate at a clock of `clock_hz`, in bit/s.
    pub const fn bit_per_s(self, clock_hz: u32) -> u32 {
        clock_hz / (self.prescaler as u32 * self.quanta())
    }
}

/// The distance of a bit timing from the ideal. The first field that differs decides; the smaller value is better.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Rank {
    rate_error_ppm: u64,
    /// The shortfall from [`BitTiming::CRYSTAL_ERROR_PPM`].
    intolerance_ppm: u32,
    /// In 1/1000 of the bit.
    sample_point_error: u32,
}

impl Rank {
    const WORST: Self =
        Self { rate_error_ppm: u64::MAX, intolerance_ppm: u32::MAX, sample_point_error: u32::MAX };

    /// The operator `<`, which cannot be called in a constant.
    const fn is_better_than(&self, other: &Self) -> bool {
        if self.rate_error_ppm != other.rate_error_ppm {
            return self.rate_error_ppm < other.rate_error_ppm;
        }
        if self.intolerance_ppm != other.intolerance_ppm {
            return self.intolerance_ppm < other.intolerance_ppm;
        }
        self.sample_point_error < other.sample_point_error
    }
}

#[cfg(test)]
mod tests {
    use super::Rank;

    #[test]
    fn a_rank_is_better_than_another_if_it_is_less() {
        let numbers = || 0..3;
        let ranks = || {
            numbers().flat_map(move |rate| {
                numbers().flat_map(move |intolerance_ppm| {
                    numbers().map(move |sample_point_error| Rank {
                        rate_error_ppm: rate.into(),
                        intolerance_ppm,
                        sample_point_error,
                    })
                })
            })
        };
        for a in ranks() {
            for b in ranks() {
                assert_eq!(a.is_better_than(&b), a < b, "{a:?}, {b:?}");
            }
        }
    }
}
