//! The two silent periods of a switch of the bit rate.

use std::time::{Duration, Instant};

use canopen_node::{BitRate, lss::Request};

use super::rates;
use crate::{
    adapter::{HOST_CLOCK, Received},
    bench::Bench,
    report::Switch,
    stop::Stop,
};

/// A COB-ID that no node uses: the frame is only to be acknowledged.
const UNUSED: u16 = 0x7FE;
/// A frame this soon after the request was under way before it.
const UNDER_WAY_MS: f64 = 15.0;
/// The uncertainty of the request's time and of a stamp.
const EARLY_MS: f64 = 5.0;
/// The same, and the wait for the bus.
const LATE_MS: f64 = 30.0;

pub fn run(bench: &mut Bench) -> Result<(), Stop> {
    if !rates::can_change(bench) {
        return Ok(());
    }
    let Some(other) = rates::another(bench, &[BitRate::Kbit500, BitRate::Kbit125]) else {
        bench.report.not_tried("a switch", "the product offers one bit rate only");
        return Ok(());
    };
    let delays: &[u16] = if bench.is_quick { &[500] } else { &[500, 1000] };
    for &delay in delays {
        for rate in [other, bench.base] {
            switch(bench, rate, delay)?;
        }
    }
    // The short heartbeat ends.
    bench.restart()?;
    Ok(())
}

/// Switches to `to`. A short heartbeat shows when the boards are silent.
fn switch(bench: &mut Bench, to: BitRate, delay_ms: u16) -> Result<(), Stop> {
    const HEARTBEAT_MS: u16 = 20;
    let from = bench.bus.rate();
    let what = format!("{} to {to}, switch delay {delay_ms} ms", from.kbit_per_s());
    bench.set_heartbeats(HEARTBEAT_MS)?;
    bench.bus.request(Request::SwitchToConfiguration)?;
    let accepted = bench.bus.ask(Request::ConfigureBitTiming { table: 0, index: to.index() })?;
    if accepted.is_none() {
        bench.report.failed(&what, "configure bit timing is not answered", "13 00");
        return Ok(());
    }
    let heartbeats = bench.bus.collect(Duration::from_millis(200))?;
    bench.bus.request(Request::ActivateBitTiming(delay_ms))?;
    let latency = ms(bench.bus.latency());
    let line = TimeLine::new(Instant::now(), &heartbeats);
    let delay = Duration::from_millis(delay_ms.into());

    // The first period: silent, but acknowledging at the old rate.
    let mut acknowledged = Vec::new();
    let mut received = bench.bus.collect(line.until(delay / 2))?;
    acknowledged.extend(acknowledge(bench, &line, &mut received)?);
    // The adapter changes its rate in the second period, when the boards have changed theirs.
    received.extend(bench.bus.collect(line.until(delay + delay / 4))?);
    bench.bus.open(to)?;
    received.extend(bench.bus.collect(line.until(delay + delay / 2 + delay / 10))?);
    acknowledged.extend(acknowledge(bench, &line, &mut received)?);
    bench.bus.request(Request::InquireNodeId)?;
    let first = bench.bus.wait_for(line.until(2 * delay + Duration::from_secs(1)), |_| true)?;
    received.extend(first);

    let times: Vec<_> = heartbeats.iter().chain(&received).map(|frame| line.place(frame)).collect();
    let last_frame = times
        .iter()
        .copied()
        .filter(|at| *at < UNDER_WAY_MS + latency)
        .fold(f64::NEG_INFINITY, f64::max);
    let first_frame = times.iter().copied().find(|at| *at >= UNDER_WAY_MS + latency);
    let clock = if line.has_stamps(&received) { bench.bus.clock() } else { HOST_CLOCK };
    let expected = 2.0 * f64::from(delay_ms);
    let seen = match first_frame {
        None => "silent after the switch".to_owned(),
        Some(at) => format!("the first frame after {at:.0} ms, by {clock}"),
    };
    let is_good = first_frame
        .is_some_and(|at| (expected - EARLY_MS..expected + LATE_MS + latency).contains(&at));
    bench.report.expect(format!("{what}: silence"), is_good, seen, format!("{expected:.0} ms"));
    for (at, is_acknowledged) in &acknowledged {
        let rate = if *at < f64::from(delay_ms) { from } else { to };
        let what = format!("{what}: a frame at {at:.0} ms is acknowledged at {rate}");
        let words = ["acknowledged", "errors on the bus"];
        bench.report.either(what, *is_acknowledged, words);
    }
    if acknowledged.is_empty() {
        let what = format!("{what}: acknowledge in the silence");
        bench.report.not_tried(what, "the adapter reports no errors");
    }
    bench.report.switches.push(Switch {
        from_kbit_per_s: from.kbit_per_s(),
        to_kbit_per_s: to.kbit_per_s(),
        delay_ms,
        last_frame_ms: last_frame.max(-100.0),
        first_frame_ms: first_frame,
        acknowledged,
    });
    if first_frame.is_none() {
        bench.settle()?;
    }
    Ok(())
}

/// Time in ms since the request to activate, for frames with time stamps of another clock.
struct TimeLine {
    zero: Instant,
    /// The computer's time minus that of the stamps, for the frame that came here fastest.
    offset: f64,
}

impl TimeLine {
    fn new(zero: Instant, frames: &[Received]) -> Self {
        let mut line = Self { zero, offset: 0.0 };
        let offsets = frames.iter().map(|frame| line.here(frame) - ms(frame.at));
        line.offset = offsets.fold(f64::INFINITY, f64::min);
        line
    }

    /// The rest of the time until `time` after zero.
    fn until(&self, time: Duration) -> Duration {
        time.saturating_sub(self.zero.elapsed())
    }

    /// The time at which this program got the frame.
    fn here(&self, frame: &Received) -> f64 {
        match frame.here.checked_duration_since(self.zero) {
            Some(time) => ms(time),
            None => -ms(self.zero.duration_since(frame.here)),
        }
    }

    /// The time of the frame by its stamp, or by the computer if the adapter's clock has been set.
    fn place(&self, frame: &Received) -> f64 {
        let stamped = ms(frame.at) + self.offset;
        let here = self.here(frame);
        if (stamped - here).abs() < 500.0 { stamped } else { here }
    }

    /// Whether the stamps of all frames are good.
    fn has_stamps(&self, frames: &[Received]) -> bool {
        frames.iter().all(|frame| (ms(frame.at) + self.offset - self.here(frame)).abs() < 500.0)
    }
}

fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

/// Sends a frame and returns its time and whether it was acknowledged, if the adapter can report that.
fn acknowledge(
    bench: &mut Bench,
    line: &TimeLine,
    received: &mut Vec<Received>,
) -> Result<Option<(f64, bool)>, Stop> {
    if bench.bus.status()?.is_none() {
        return Ok(None);
    }
    let at = ms(line.zero.elapsed());
    bench.bus.send_to(UNUSED, &[])?;
    received.extend(bench.bus.collect(Duration::from_millis(20))?);
    Ok(bench.bus.status()?.map(|status| (at, !status.has_errors)))
}
