//! All bit rates, by activation and by store and reset.

use std::time::{Duration, Instant};

use canopen_node::{BitRate, lss::Request};

use super::timing;
use crate::{
    bench::{Bench, RESET_NODE},
    board,
    stop::Stop,
};

/// The switch delay: longer than the adapter takes to change its rate.
const DELAY_MS: u16 = 300;
/// The number of answers that are measured at each rate.
const ANSWERS: usize = 20;
/// The rates at which a bad bus shows first.
const FAST: [BitRate; 3] = [BitRate::Kbit1000, BitRate::Kbit800, BitRate::Kbit500];

/// The rates to try, the base rate last: the session ends where it began.
fn rates(bench: &mut Bench) -> Vec<BitRate> {
    let wanted: &[BitRate] = match bench.is_quick {
        true => &[BitRate::Kbit1000, BitRate::Kbit250, BitRate::Kbit10],
        false => &BitRate::ALL,
    };
    let (mut rates, refused): (Vec<_>, Vec<_>) =
        wanted.iter().copied().partition(|rate| bench.can_go(*rate));
    for rate in refused {
        let is_lacking = bench.lacking.contains(&rate);
        let who = if is_lacking { "the adapter lacks it" } else { "the product does not offer it" };
        bench.report.not_tried(rate.to_string(), who);
    }
    rates.retain(|rate| *rate != bench.base);
    rates.push(bench.base);
    rates
}

/// Reports that the rate of the adapter cannot be set; returns whether it can.
pub fn can_change(bench: &mut Bench) -> bool {
    let is_fixed = bench.bus.fixed_rate().is_some();
    if is_fixed {
        bench.report.not_tried("other bit rates", "the adapter's bit rate is fixed");
    }
    !is_fixed
}

/// A rate other than the base rate that the boards offer, one of these if possible.
pub fn another(bench: &Bench, preferred: &[BitRate]) -> Option<BitRate> {
    let mut rates = preferred.iter().chain(&bench.offered).copied();
    rates.find(|rate| *rate != bench.base && bench.can_go(*rate))
}

pub fn by_activation(bench: &mut Bench) -> Result<(), Stop> {
    if !can_change(bench) {
        return Ok(());
    }
    let mut bad = Vec::new();
    let rates = rates(bench);
    for &rate in &rates {
        let from = bench.bus.rate();
        bench.bus.request(Request::SwitchToConfiguration)?;
        let accepted =
            bench.bus.ask(Request::ConfigureBitTiming { table: 0, index: rate.index() })?;
        if !matches!(accepted, Some([0x13, 0, ..])) {
            bench.report.failed(
                format!("configure bit timing, {rate}"),
                board::answer_text(accepted),
                "13 00",
            );
            continue;
        }
        bench.bus.request(Request::ActivateBitTiming(DELAY_MS))?;
        let requested = Instant::now();
        let delay = Duration::from_millis(DELAY_MS.into());
        bench.bus.pass(delay + delay / 4)?;
        bench.bus.open(rate)?;
        bench
            .bus
            .pass((2 * delay + Duration::from_millis(30)).saturating_sub(requested.elapsed()))?;
        let what = format!("{} to {rate} by activation", from.kbit_per_s());
        if !check(bench, rate, &what)? {
            bad.push(rate);
            bench.settle()?;
        }
    }
    if let Some(words) = suspect(&rates, &bad) {
        bench.report.bench(words);
    }
    Ok(())
}

pub fn by_store(bench: &mut Bench) -> Result<(), Stop> {
    if !can_change(bench) {
        return Ok(());
    }
    let mut bad = Vec::new();
    let rates = rates(bench);
    for &rate in &rates {
        let what = format!("{rate} by store and reset");
        if !bench.store(&what, &bench.boards.clone(), rate.into())? {
            bench.settle()?;
            continue;
        }
        bench.bus.nmt(RESET_NODE, 0)?;
        // The command must have left before the adapter does.
        bench.bus.flush()?;
        let before = bench.bus.rate();
        bench.bus.open(rate)?;
        bench.bus.pass(Duration::from_millis(300))?;
        if check(bench, rate, &what)? {
            continue;
        }
        bad.push(rate);
        if rate != before {
            bench.bus.open(before)?;
            if bench.missing()?.is_empty() {
                bench.report.failed(
                    format!("{what}: the stored value is lost"),
                    format!("the boards are at {before} after the reset"),
                    format!("{rate}, which 17 00 said was stored"),
                );
            }
        }
        bench.settle()?;
    }
    if let Some(words) = suspect(&rates, &bad) {
        bench.report.bench(words);
    }
    Ok(())
}

/// Checks that all boards answer at this rate, without errors on the bus.
fn check(bench: &mut Bench, rate: BitRate, what: &str) -> Result<bool, Stop> {
    let missing = bench.missing()?;
    if !missing.is_empty() {
        let seen = format!("silent after the switch: {}", missing.join("; "));
        bench.report.failed(what, seen, "an answer of each board");
        return Ok(false);
    }
    bench.bus.status()?;
    for board in bench.boards.clone() {
        let _ = board::select(&mut bench.bus, board.address)?;
        timing::measure(bench, what, ANSWERS)?;
        if bench.skips(board, &format!("{what}: rate in use"), (0x2000, 6))? {
            continue;
        }
        let seen = bench.shown(board, (0x2000, 6), |kbit| format!("{kbit} kbit/s"))?;
        bench.report.equal(format!("{board}: rate in use, 2000h sub 6"), seen, &rate.to_string());
    }
    let has_errors = bench.bus.status()?.is_some_and(|status| status.has_errors);
    if has_errors {
        bench.report.failed(format!("{what}: errors on the bus"), "the adapter saw errors", "none");
    }
    Ok(!has_errors)
}

/// The cause of bad rates among those that were tried, if there is a likely one.
fn suspect(rates: &[BitRate], bad: &[BitRate]) -> Option<&'static str> {
    let good = || rates.iter().filter(|rate| !bad.contains(rate));
    // The index of a rate in the table of CiA 305 grows as the rate falls.
    let slowest_good = good().map(|rate| rate.index()).max()?;
    if bad == [BitRate::Kbit800] {
        return Some(
            "adapter suspected: only 800 kbit/s fails. Some adapters have 750 kbit/s in its place, or no exact timing for it",
        );
    }
    if !bad.is_empty() && bad.iter().all(|rate| rate.index() > slowest_good) {
        return Some(
            "transceiver suspected: only slow bit rates fail. The dominant time-out of many transceivers is shorter than 11 \
             bits of them: 0.45 ms needs 50 kbit/s or more. That of the adapter may be the one",
        );
    }
    let slow_are_good = good().any(|rate| !FAST.contains(rate));
    (!bad.is_empty() && slow_are_good && bad.iter().all(|rate| FAST.contains(rate))).then_some(
        "termination suspected: only fast bit rates fail. There must be 120 ohm between CANH and CANL at both ends \
         of the bus and nowhere else (60 ohm without power), and the cable must be short: 25 m at 1000 kbit/s. \
         A wrong sample point or crystal does the same",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rates_that_fail_name_a_part_of_the_bench() {
        let named =
            |bad: &[BitRate]| suspect(&BitRate::ALL, bad).and_then(|words| words.split(' ').next());
        let [kbit_10, kbit_20] = [BitRate::Kbit10, BitRate::Kbit20];
        for (bad, part) in [
            (&[][..], None),
            (&[kbit_10], Some("transceiver")),
            (&[kbit_20, kbit_10], Some("transceiver")),
            (&[BitRate::Kbit800], Some("adapter")),
            (&[BitRate::Kbit1000], Some("termination")),
            (&[BitRate::Kbit800, BitRate::Kbit1000], Some("termination")),
            (&[kbit_20], None),
            (&[BitRate::Kbit125], None),
            (&BitRate::ALL, None),
        ] {
            assert_eq!(named(bad), part, "{bad:?}");
        }
    }
}
