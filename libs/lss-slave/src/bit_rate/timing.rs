//! The bit timing of a rate at a given clock of the controller.

use super::BitRate;

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
        let mut best_rank = u128::MAX;
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
                // The less the better: the first criterion is in the highest bits.
                let rank = ((error_ppm / prescaler) as u128) << 64
                    | (intolerance as u128) << 32
                    | sample_point.abs_diff(Self::SAMPLE_POINT) as u128;
                if segment1 >= 1
                    && segment1 <= 16
                    && sample_point >= *sample_points.start()
                    && sample_point <= *sample_points.end()
                    && rank < best_rank
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

    /// The best bit timing for each rate, by index of the bit timing table of LSS, for a constant: to solve takes long.
    pub const fn table(clock_hz: u32) -> [Option<Self>; 10] {
        let mut table = [None; 10];
        let mut at = 0;
        while at < BitRate::ALL.len() {
            let rate = BitRate::ALL[at];
            table[rate.index() as usize] = Self::solve(rate, clock_hz);
            at += 1;
        }
        table
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
