//! Boards that find the bit rate: automatic detection, and the rescue from a wrong stored rate.

use std::time::{Duration, Instant};

use canopen_node::{BitRate, BitRateSetting, lss::Request};
use conformance::lss::Feature;

use super::rates;
use crate::{
    adapter::Received,
    bench::{Bench, RESET_NODE, SEARCH},
    board::Board,
    stop::Stop,
};

/// A COB-ID that no node uses: the frame only shows the bit rate.
const UNUSED: u16 = 0x7FE;
/// The interval of the frames by which boards detect the rate.
const INTERVAL: Duration = Duration::from_millis(100);

pub fn detection(bench: &mut Bench) -> Result<(), Stop> {
    if !bench.detects {
        let why = "the product does not offer it (BIT_RATES in src/device.rs)";
        bench.report.not_tried("detection", why);
        return Ok(());
    }
    let boards = bench.boards.clone();
    if !bench.store("store automatic", &boards, BitRateSetting::Automatic)? {
        return Ok(());
    }
    let others: &[BitRate] = match (bench.is_quick, bench.bus.fixed_rate()) {
        (_, Some(_)) | (true, _) => &[],
        _ => &[BitRate::Kbit1000, BitRate::Kbit500, BitRate::Kbit50, BitRate::Kbit10],
    };
    let base = bench.base;
    let is_other = |rate: &BitRate| *rate != base && bench.can_go(*rate);
    let rates: Vec<_> = others.iter().copied().filter(is_other).chain([base]).collect();
    for rate in rates {
        bench.bus.nmt(RESET_NODE, 0)?;
        // The command must have left before the adapter does.
        bench.bus.flush()?;
        bench.bus.open(rate)?;
        // What was received before the reset is no sign of life.
        bench.bus.pass(Duration::ZERO)?;
        let begin = Instant::now();
        let mut nodes = Vec::new();
        while begin.elapsed() < SEARCH && !bench.is_each_in(&nodes) {
            bench.bus.send_to(UNUSED, &[])?;
            // Boards that find the rate together acknowledge each other's boot-ups, perhaps while the adapter, error
            // passive by then, still ends its last attempt and misses them.
            nodes.extend(bench.signs_of_life(INTERVAL)?);
        }
        let is_good = bench.is_each_in(&nodes);
        let seen = match is_good {
            true => format!("detected in {:.1} s", begin.elapsed().as_secs_f64()),
            false => format!("only nodes {nodes:?} within {} s", SEARCH.as_secs()),
        };
        bench.report.expect(
            rate.to_string(),
            is_good,
            seen,
            "a boot-up or a heartbeat of each board",
        );
        if !is_good {
            return Ok(());
        }
    }
    bench.store("store the base rate", &boards, base.into())?;
    bench.restart()?;
    Ok(())
}

pub fn rescue(bench: &mut Bench) -> Result<(), Stop> {
    if bench.product.lacks(Feature::Rescue) {
        let why = "the product is without it (`with_rescue` in src/device.rs)";
        bench.report.not_tried("rescue", why);
        return Ok(());
    }
    let preferred = [BitRate::Kbit250, BitRate::Kbit500];
    let Some(wrong) = rates::another(bench, &preferred) else {
        bench.report.not_tried("rescue", "the product offers one bit rate only");
        return Ok(());
    };
    // One after the other: boards at the same wrong rate would receive each other, and stay.
    for board in bench.boards.clone() {
        if !rescue_of(bench, board, wrong)? {
            break;
        }
    }
    Ok(())
}

/// Returns whether the board has its settings again.
fn rescue_of(bench: &mut Bench, board: Board, wrong: BitRate) -> Result<bool, Stop> {
    /// The emergency error code of a board that is a guest at another rate.
    const GUEST: u16 = 0xFF10;
    let base = bench.base;
    let what = format!("{board} with {wrong} stored");
    if !bench.store(&what, &[board], wrong.into())? {
        return Ok(false);
    }
    let id = board.id.get();
    bench.bus.nmt(RESET_NODE, id)?;
    let begin = Instant::now();
    bench.bus.take_unasked();
    let is_there = bench.reach(board.address, SEARCH)?;
    let seen = match is_there {
        true => format!("answers at {base} after {:.1} s", begin.elapsed().as_secs_f64()),
        false => format!("no answer in {} s", SEARCH.as_secs()),
    };
    let expected = "an answer at the rate of the bus; `--without rescue` for a product without it";
    bench.report.expect(what, is_there, seen, expected);
    if !is_there {
        return Ok(false);
    }
    bench.bus.request(Request::SwitchToWaiting)?;
    bench.bus.pass(Duration::from_millis(300))?;
    let is_received = bench.bus.take_unasked().iter().any(|Received { frame, .. }| {
        frame.cob_id() == 0x080 + u16::from(id) && frame.data().starts_with(&GUEST.to_le_bytes())
    });
    // The adapter may be bus-off while boards that have found it exchange their messages.
    let mut is_recorded = false;
    for sub_index in 1..=bench.number(board, 0x1003, 0)?.unwrap_or(0) as u8 {
        let entry = bench.number(board, 0x1003, sub_index)?;
        is_recorded |= entry.is_ok_and(|entry| entry as u16 == GUEST);
    }
    let seen = match (is_received, is_recorded) {
        (true, _) => "received",
        (false, true) => {
            "in the history 1003h, but not received: the adapter may have been bus-off"
        }
        (false, false) => "neither received nor in the history 1003h",
    };
    let what = format!("{board}: emergency FF10h");
    bench.report.under("CiA 301, 7.2.7").expect(what, is_received || is_recorded, seen, "received");
    for (sub_index, expected, name) in [
        (5, wrong.kbit_per_s(), "home rate"),
        (6, base.kbit_per_s(), "rate in use"),
        (7, 1, "rescues"),
    ] {
        if bench.skips(board, name, (0x2000, sub_index))? {
            continue;
        }
        let seen = bench.shown(board, (0x2000, sub_index), |number| number.to_string())?;
        let what = format!("{board}: {name}, 2000h sub {sub_index}");
        bench.report.equal(what, seen, &expected.to_string());
    }
    let is_stored = bench.store("store the base rate", &[board], base.into())?;
    bench.restart()?;
    Ok(is_stored)
}
