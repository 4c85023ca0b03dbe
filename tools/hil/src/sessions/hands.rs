//! What only hands can do: a power cut, and a short circuit of the bus.

use std::time::{Duration, Instant};

use lss_master::Configure;

use crate::{bench::Bench, board, stop::Stop};

/// The wait for the person's hands.
const HANDS: Duration = Duration::from_secs(60);
/// The heartbeats of the boards come much more often before a short circuit.
const QUIET: Duration = Duration::from_millis(500);
/// The wait for a board after the end of a short circuit.
const RECOVERY: Duration = Duration::from_secs(5);

pub fn run(bench: &mut Bench) -> Result<(), Stop> {
    power_cut(bench)?;
    bench.settle()?;
    short_circuit(bench)
}

/// Whether there is a person who agrees.
fn agrees(bench: &Bench, question: &str) -> bool {
    if bench.person.is_present() {
        println!("  ?       {question} [y = yes, Enter = no]");
    }
    bench.person.agrees(|| bench.bus.check_interrupt().is_err())
}

/// A stored node-ID is active after the power was away. The boot-up with it proves both.
fn power_cut(bench: &mut Bench) -> Result<(), Stop> {
    let question = "Can you switch the power of the first board off and on?";
    if !agrees(bench, question) {
        bench
            .report
            .not_tried("settings through a power cut", "nobody at hand to switch the power");
        return Ok(());
    }
    let (board, other) = (bench.boards[0], bench.free_id());
    let configure = Configure::node_id(Some(other));
    if let Err(why) = board::store(&mut bench.bus, board.address, configure)? {
        bench.report.failed("a node-ID is stored", why, "11 00, 17 00");
        return Ok(());
    }
    bench.report.progress("now: switch the power off, wait 2 s, switch it on again");
    bench.check_boot_up("settings through a power cut", other, HANDS)?;
    bench.bus.heard.remove(&other.get());
    Ok(())
}

/// A short circuit leads to bus-off; the boards come back by themselves.
fn short_circuit(bench: &mut Bench) -> Result<(), Stop> {
    let question = "May the bus be shorted? You would connect CANH and CANL with a wire for 2 s";
    if !agrees(bench, question) {
        bench
            .report
            .under("ISO 11898-1, bus-off")
            .not_tried("bus-off by a short circuit", "nobody has agreed to it");
        return Ok(());
    }
    if bench.bus.status()?.is_none() {
        bench
            .report
            .under("ISO 11898-1, bus-off")
            .not_tried("bus-off by a short circuit", "the adapter reports no errors");
        return Ok(());
    }
    // With a short heartbeat the boards are bus-off soon.
    bench.set_heartbeats(20)?;
    bench.report.progress("now: connect CANH and CANL for 2 s");
    let until = Instant::now() + HANDS;
    // An adapter that sends nothing may see a quiet bus instead of errors.
    let mut is_shorted = false;
    while !is_shorted && Instant::now() < until {
        let is_quiet = bench.bus.wait_for(QUIET, |_| true)?.is_none();
        is_shorted = is_quiet || bench.bus.status()?.is_some_and(|status| status.has_errors);
    }
    if !is_shorted {
        bench
            .report
            .under("ISO 11898-1, bus-off")
            .not_tried("bus-off by a short circuit", "the bus was not shorted within 60 s");
        return Ok(());
    }
    // The adapter may be bus-off itself: it joins the bus again until the boards are heard.
    let until = Instant::now() + HANDS;
    let mut end = None;
    while end.is_none() && Instant::now() < until {
        bench.bus.open(bench.base)?;
        end = bench.bus.wait_for(Duration::from_millis(200), |_| true)?;
    }
    let mut missing = bench.missing()?;
    let until = Instant::now() + RECOVERY;
    while !missing.is_empty() && Instant::now() < until {
        missing = bench.missing()?;
    }
    let words = ["all boards answer again", &missing.join("; ")];
    bench.report.under("ISO 11898-1, bus-off").either(
        "after a short circuit",
        missing.is_empty(),
        words,
    );
    for board in bench.boards.clone() {
        if let Ok(count) = bench.number(board, 0x2000, 1)? {
            bench.report.under("ISO 11898-1, bus-off").expect(
                format!("{board}: recoveries from bus-off, 2000h sub 1"),
                count > 0,
                count.to_string(),
                "at least 1",
            );
        }
    }
    bench.restart()?;
    Ok(())
}
