//! Answer times, and requests without a pause between them.

use std::time::{Duration, Instant};

use canopen_node::{
    BitRate,
    lss::{AddressPart, Request},
};

use crate::{bench::Bench, board, bus::bits, report::Answer, stop::Stop};

/// The bits of a request and its answer, stuff bits included.
const EXCHANGE_BITS: u32 = 2 * 130;
/// The time that a board, the computer and the adapter's line may take together. A board takes 4 us; a master with a
/// time-out of 20 ms must be served.
const SLACK: Duration = Duration::from_millis(15);

pub fn answers(bench: &mut Bench) -> Result<(), Stop> {
    let count = if bench.is_quick { 50 } else { 300 };
    for board in bench.boards.clone() {
        let _ = board::select(&mut bench.bus, board.address)?;
        measure(bench, &format!("{board}: inquire node-ID"), count)?;
        let begin = Instant::now();
        let stored = bench.bus.ask(Request::StoreConfiguration)?;
        let seen = format!("{:.1} ms", begin.elapsed().as_secs_f64() * 1e3);
        let limit = Duration::from_millis(20) + limit(bench, bench.base);
        let is_good = stored.is_some() && begin.elapsed() < limit;
        let expected = format!("less than {} ms", limit.as_millis());
        let what = format!("{board}: store configuration");
        bench.report.under("CiA 305, store configuration").expect(what, is_good, seen, expected);
    }
    Ok(())
}

/// The longest median answer time at the computer.
fn limit(bench: &Bench, rate: BitRate) -> Duration {
    bits(EXCHANGE_BITS, rate) + 2 * bench.bus.latency() + SLACK
}

/// Asks the board in LSS configuration state for its node-ID `count` times.
pub fn measure(bench: &mut Bench, what: &str, count: usize) -> Result<(), Stop> {
    let rate = bench.bus.rate();
    let mut times = Vec::new();
    let mut lost = 0;
    for _ in 0..count {
        let answer = bench.bus.ask(Request::InquireNodeId)?;
        match (answer, bench.bus.last_answer) {
            (Some([0x5E, ..]), Some(time)) => times.push(time),
            _ => lost += 1,
        }
        if lost == 5 {
            break;
        }
    }
    let answer =
        |time: &Duration| Answer { kbit_per_s: rate.kbit_per_s(), us: time.as_micros() as u64 };
    bench.report.answers.extend(times.iter().map(answer));
    times.sort();
    let Some((&least, &most)) = times.first().zip(times.last()) else {
        bench.report.failed(what, "no answer", "an answer to each");
        return Ok(());
    };
    let median = times[times.len() / 2];
    let ms = |time: Duration| format!("{:.1} ms", time.as_secs_f64() * 1e3);
    let seen =
        format!("{} of {count}, {} to {}, median {}", times.len(), ms(least), ms(most), ms(median));
    let limit = limit(bench, rate);
    bench.report.expect(what, lost == 0, &seen, "an answer to each");
    if lost == 0 && median > limit {
        let expected = format!("a median below {}", ms(limit));
        bench.report.failed(format!("{what}: late answers"), ms(median), expected);
    }
    Ok(())
}

/// Six requests at once get five answers, in their order.
pub fn bursts(bench: &mut Bench) -> Result<(), Stop> {
    let rounds = if bench.is_quick { 5 } else { 20 };
    for board in bench.boards.clone() {
        let address = board.address;
        let mut worst = None;
        for _ in 0..rounds {
            bench.bus.take_unasked();
            // A second board would answer 5D too: only the first request is for all.
            if bench.boards.len() == 1 {
                bench.bus.request(Request::SwitchToConfiguration)?;
            } else {
                let _ = board::select(&mut bench.bus, address)?;
            }
            for part in (0..4).filter_map(AddressPart::new) {
                bench.bus.request(Request::Inquire(part))?;
            }
            bench.bus.request(Request::InquireNodeId)?;
            let until = Instant::now() + bench.bus.patience() + bits(1500, bench.base);
            let mut commands = Vec::new();
            while commands.len() < 5
                && let Some(received) = bench.bus.receive(until)?
            {
                if received.frame.cob_id() == 0x7E4 {
                    commands.extend(received.frame.data().first());
                }
            }
            if commands != [0x5A, 0x5B, 0x5C, 0x5D, 0x5E] {
                worst = Some(commands);
            }
            bench.bus.request(Request::SwitchToWaiting)?;
        }
        let seen = match &worst {
            None => format!("5A 5B 5C 5D 5E, {rounds} times"),
            Some(commands) => format!("a lost request: answers {}", board::text(commands)),
        };
        let what = format!("{board}: switch state and five inquiries without a pause");
        bench.report.expect(what, worst.is_none(), seen, "5A 5B 5C 5D 5E");
    }
    Ok(())
}
