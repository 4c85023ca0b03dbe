//! The solver for bxCAN bit timing, compared with an exhaustive search over the clocks of an STM32F4.

use std::{cmp::Reverse, collections::BTreeSet};

use canopen_node::{BitRate, BitRateSetting, BitRates, bit_rate::BitTiming};
use testkit::random::{Random, every};

const MHZ: u32 = 1_000_000;
/// The fastest APB1 of any STM32F4 (RM0402, RM0430: 50 MHz).
const MAX_APB1: u32 = 50 * MHZ;

fn rate_hz(rate: BitRate) -> u64 {
    u64::from(rate.kbit_per_s()) * 1000
}

/// The relative error of the rate as an exact fraction, numerator and denominator.
fn rate_error(timing: BitTiming, rate: BitRate, clock_hz: u32) -> (u64, u64) {
    let exact = rate_hz(rate) * u64::from(timing.prescaler) * u64::from(timing.quanta());
    (exact.abs_diff(clock_hz.into()), exact)
}

/// The tolerance of both crystals in opposite directions, in ppm, with the widest jump: the two conditions of ISO
/// 11898-1.
fn crystal_tolerance(timing: BitTiming) -> u32 {
    let [quanta, segment1, segment2] =
        [timing.quanta(), timing.segment1.into(), timing.segment2.into()].map(f64::from);
    let jump = segment2.min(4.0) / (20.0 * quanta);
    let phase = segment1.min(segment2) / (2.0 * (13.0 * quanta - segment2));
    (jump.min(phase) * 1e6) as u32
}

/// The exact sample point in 1/1000: at or between `from` and `to`.
fn is_sampled_between(timing: BitTiming, from: u32, to: u32) -> bool {
    let sampled = 1000 * (1 + u32::from(timing.segment1));
    (from * timing.quanta()..=to * timing.quanta()).contains(&sampled)
}

/// Whether CiA 301 and the registers allow `timing`. A bit has 8..=25 quanta (ISO 11898-1).
fn is_allowed(timing: BitTiming, rate: BitRate, clock_hz: u32) -> bool {
    let (error, exact) = rate_error(timing, rate, clock_hz);
    let from = if rate_hz(rate) >= 800_000 { 750 } else { 850 };
    (1..=1024).contains(&timing.prescaler)
        && (1..=16).contains(&timing.segment1)
        && (1..=8).contains(&timing.segment2)
        && (8..=25).contains(&timing.quanta())
        && error * 1000 <= exact
        && is_sampled_between(timing, from, 900)
}

/// All allowed timings, found by trying every combination of the registers.
fn all_allowed(rate: BitRate, clock_hz: u32) -> Vec<BitTiming> {
    let mut all = Vec::new();
    for prescaler in 1..=1024 {
        // The segments matter only if 8..=25 quanta come near the rate.
        let quanta = u64::from(clock_hz) / (rate_hz(rate) * u64::from(prescaler));
        if !(7..=25).contains(&quanta) {
            continue;
        }
        for segment1 in 1..=16 {
            for segment2 in 1..=8 {
                let timing = BitTiming { prescaler, segment1, segment2, sync_jump_width: 1 };
                if is_allowed(timing, rate, clock_hz) {
                    all.push(timing);
                }
            }
        }
    }
    all
}

/// The APB1 clocks that crystals of usual frequencies give, directly and through the PLL (RM0090, 7.3.2): VCO input
/// 1..=2 MHz, VCO 100..=432 MHz, SYSCLK at most 180 MHz.
fn reachable_clocks() -> BTreeSet<u32> {
    const CRYSTALS: [u32; 9] = [
        4_000_000, 7_372_800, 8_000_000, 11_059_200, 12_000_000, 14_745_600, 16_000_000,
        25_000_000, 26_000_000,
    ];
    let mut clocks = BTreeSet::new();
    for crystal in CRYSTALS {
        clocks.extend([1, 2, 4].map(|apb1| crystal / apb1));
        for m in crystal.div_ceil(2 * MHZ)..=crystal / MHZ {
            for n in (50..=432).step_by(7) {
                let vco = u64::from(crystal) * n / u64::from(m);
                if !(100_000_000..=432_000_000).contains(&vco) {
                    continue;
                }
                for p in [2, 4, 8] {
                    let sysclk = (vco / p) as u32;
                    clocks.extend([4, 16].map(|apb1| sysclk / apb1));
                }
            }
        }
    }
    clocks.retain(|&clock| clock <= MAX_APB1);
    clocks
}

fn whole_mhz() -> impl Iterator<Item = u32> {
    (1..=50).map(|mhz| mhz * MHZ)
}

#[test]
fn a_solution_is_allowed_by_cia_301_and_by_the_registers() {
    let mut random = Random::from_environment();
    let any = (0..5_000).map(|_| random.within(1..MAX_APB1.into()) as u32);
    let mut solutions = 0;
    let extremes = [0, 1, 999, 79_999, 80_000, u32::MAX];
    for clock_hz in whole_mhz().chain(reachable_clocks()).chain(any).chain(extremes) {
        for rate in BitRate::ALL {
            if let Some(timing) = BitTiming::solve(rate, clock_hz) {
                assert!(is_allowed(timing, rate, clock_hz), "{rate:?} {clock_hz} Hz: {timing:?}");
                let widest = timing.segment2.min(4);
                assert_eq!(timing.sync_jump_width, widest, "{rate:?} {clock_hz} Hz");
                solutions += 1;
            }
        }
    }
    assert!(solutions > 10_000, "{solutions}");
    assert!(BitTiming::solve(BitRate::Kbit10, 80_000).is_some(), "8 quanta, prescaler 1");
}

#[test]
fn the_solution_is_best_in_rate_crystals_sample_point_and_quanta_in_order() {
    let odd: Vec<_> = reachable_clocks().into_iter().step_by(7 * every(16)).collect();
    // 20 quanta of one cycle each at 1 Mbit/s: 20 MHz, and 0.1 % on either side, which is allowed, or a little more.
    let limits = [19_979_999, 19_980_000, 20_020_000, 20_020_001];
    let has_1000 = |clock_hz| BitTiming::solve(BitRate::Kbit1000, clock_hz).is_some();
    assert_eq!(limits.map(has_1000), [false, true, true, false]);
    for clock_hz in whole_mhz().chain(odd).chain(limits) {
        for rate in BitRate::ALL {
            let badness = |timing: &BitTiming| {
                let (error, exact) = rate_error(*timing, rate, clock_hz);
                let sample_point = timing.sample_point().abs_diff(875);
                (
                    error * 1_000_000 / exact,
                    5_000_u32.saturating_sub(crystal_tolerance(*timing)),
                    sample_point,
                    timing.sample_point() > 875,
                    Reverse(timing.quanta()),
                )
            };
            let best = all_allowed(rate, clock_hz).into_iter().map(|timing| badness(&timing)).min();
            let solved = BitTiming::solve(rate, clock_hz).map(|timing| badness(&timing));
            assert_eq!(solved, best, "{rate:?} {clock_hz} Hz");
        }
    }
}

#[test]
fn the_clock_of_the_board_gives_all_rates_exactly() {
    for (rate, prescaler) in [
        (BitRate::Kbit1000, 2),
        (BitRate::Kbit800, 5),
        (BitRate::Kbit500, 4),
        (BitRate::Kbit250, 8),
        (BitRate::Kbit125, 16),
        (BitRate::Kbit50, 40),
        (BitRate::Kbit20, 100),
        (BitRate::Kbit10, 200),
    ] {
        let timing = BitTiming::solve(rate, 40 * MHZ).unwrap();
        let (segment1, segment2) = if rate == BitRate::Kbit800 { (7, 2) } else { (16, 3) };
        let expected = BitTiming { prescaler, segment1, segment2, sync_jump_width: segment2 };
        assert_eq!(timing, expected, "{rate:?}");
        let (sample_point, tolerance) =
            if rate == BitRate::Kbit800 { (800, 7_812) } else { (850, 5_836) };
        assert_eq!(timing.sample_point(), sample_point, "{rate:?}");
        assert_eq!(timing.crystal_tolerance_ppm(), tolerance, "{rate:?}");
        assert_eq!(u64::from(timing.bit_per_s(40 * MHZ)), rate_hz(rate));
    }
}

#[test]
fn crystals_are_limited_by_the_jump_width_or_by_the_shorter_segment() {
    for (segment1, segment2, sync_jump_width, ppm) in [
        (16, 3, 3, 3_000_000 / (2 * (13 * 20 - 3))),
        (12, 7, 4, 4_000_000 / (20 * 20)),
        (12, 7, 1, 1_000_000 / (20 * 20)),
        (3, 8, 4, 3_000_000 / (2 * (13 * 12 - 8))),
    ] {
        let timing = BitTiming { prescaler: 1, segment1, segment2, sync_jump_width };
        assert_eq!(timing.crystal_tolerance_ppm(), ppm, "{timing:?}");
    }
}

#[test]
fn the_rates_that_are_possible_are_those_with_a_solution() {
    for clock_hz in whole_mhz() {
        let possible = BitRates::possible(clock_hz);
        for rate in BitRate::ALL {
            let is_solved = BitTiming::solve(rate, clock_hz).is_some();
            assert_eq!(possible.contains(rate), is_solved, "{rate:?} {clock_hz} Hz");
        }
    }
    assert!(BitRate::ALL.iter().all(|&rate| BitRates::possible(32 * MHZ).contains(rate)));
    assert!(!BitRates::possible(42 * MHZ).contains(BitRate::Kbit800), "0.96 % off");
}

#[test]
fn automatic_detection_is_offered_only_on_request_and_twice_is_once() {
    let rates = BitRates::possible(40 * MHZ);
    assert!(!rates.offers(BitRateSetting::Automatic));
    assert!(rates.with_automatic().offers(BitRateSetting::Automatic));
    assert_eq!(rates.with_automatic().with_automatic(), rates.with_automatic());
}

#[test]
fn the_table_of_cia_301_has_these_rates_at_these_indices() {
    let rates = BitRate::ALL.map(|rate| (rate.index(), rate.kbit_per_s()));
    let table = [(0, 1000), (1, 800), (2, 500), (3, 250), (4, 125), (6, 50), (7, 20), (8, 10)];
    assert_eq!(rates, table);
    for index in 0..=0xFF {
        let row = rates.iter().find(|row| row.0 == index).map(|row| row.1);
        assert_eq!(BitRate::from_table(0, index).map(BitRate::kbit_per_s), row, "{index}");
        assert_eq!(row.and_then(BitRate::from_kbit_per_s), BitRate::from_table(0, index));
        for table in 1..=0xFF {
            assert_eq!(BitRate::from_table(table, index), None, "table {table}");
        }
    }
    assert_eq!(BitRate::from_kbit_per_s(100), None);
}

#[test]
fn only_40_mhz_makes_every_rate_exact_with_crystals_of_half_a_per_cent() {
    let suits = |clock_hz: &u32| {
        BitRate::ALL.iter().all(|&rate| {
            BitTiming::solve(rate, *clock_hz).is_some_and(|timing| {
                rate_error(timing, rate, *clock_hz).0 == 0
                    && crystal_tolerance(timing) >= BitTiming::CRYSTAL_ERROR_PPM
            })
        })
    };
    assert_eq!(whole_mhz().filter(suits).collect::<Vec<_>>(), [40 * MHZ]);
}

#[test]
fn the_table_has_the_timing_of_each_rate_at_its_index() {
    let table = BitTiming::table(40 * MHZ);
    for rate in BitRate::ALL {
        assert_eq!(table[usize::from(rate.index())], BitTiming::solve(rate, 40 * MHZ));
    }
    assert_eq!(table.iter().flatten().count(), BitRate::ALL.len());
}
