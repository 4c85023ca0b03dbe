//! Boards that find the bit rate: automatic detection, and the rescue from a wrong stored rate.

use std::time::{Duration, Instant};

use canopen_node::{BitRate, BitRateSetting, lss::Request};
use firmware::device::DEVICE;

use crate::{
    adapter::Received,
    bench::{Bench, RESET_NODE, SEARCH},
    board::{self, Board},
    stop::Stop,
};

/// A COB-ID that no node uses: the frame only shows the bit rate.
const UNUSED: u16 = 0x7FE;
/// The interval of the frames by which boards detect the rate.
const INTERVAL: Duration = Duration::from_millis(100);

/// Stores a bit rate on boards; a refusal is a failed check.
fn store(bench: &mut Bench, boards: &[Board], rate: BitRateSetting) -> Result<bool, Stop> {
    for board in boards {
        let stored = match board::select(&mut bench.bus, board.address)? {
            true => board::store(&mut bench.bus, Some(board.id), Some(rate))?,
            false => Err("43 is not answered".into()),
        };
        if let Err(why) = stored {
            bench.report.failed(format!("{board}: store {rate}"), why, "11 00, 13 00, 17 00");
            return Ok(false);
        }
    }
    bench.bus.request(Request::SwitchToWaiting)?;
    Ok(true)
}

pub fn detection(bench: &mut Bench) -> Result<(), Stop> {
    if !DEVICE.bit_rates.offers(BitRateSetting::Automatic) {
        bench
            .report
            .not_tried("detection", "this firmware does not offer it (BIT_RATES in src/device.rs)");
        return Ok(());
    }
    let boards = bench.boards.clone();
    if !store(bench, &boards, BitRateSetting::Automatic)? {
        return Ok(());
    }
    let others: &[BitRate] = match (bench.is_quick, bench.bus.fixed_rate()) {
        (_, Some(_)) | (true, _) => &[],
        _ => &[BitRate::Kbit1000, BitRate::Kbit500, BitRate::Kbit50, BitRate::Kbit10],
    };
    let base = bench.base;
    let rates: Vec<_> = others.iter().copied().filter(|rate| *rate != base).chain([base]).collect();
    for rate in rates {
        bench.bus.nmt(RESET_NODE, 0)?;
        // The command must have left before the adapter does.
        bench.bus.flush()?;
        bench.bus.open(rate)?;
        let begin = Instant::now();
        let mut nodes = Vec::new();
        let is_complete = |nodes: &[u8], bench: &Bench| {
            bench.boards.iter().all(|board| nodes.contains(&board.id.get()))
        };
        while begin.elapsed() < SEARCH && !is_complete(&nodes, bench) {
            bench.bus.send_to(UNUSED, &[])?;
            nodes.extend(bench.boot_ups(INTERVAL)?);
        }
        let seen = match is_complete(&nodes, bench) {
            true => format!("detected in {:.1} s", begin.elapsed().as_secs_f64()),
            false => format!("boot-ups of {nodes:?} in {} s", SEARCH.as_secs()),
        };
        let is_good = is_complete(&nodes, bench);
        bench.report.expect(
            format!("{} kbit/s", rate.kbit_per_s()),
            is_good,
            seen,
            "a boot-up of each board",
        );
        if !is_good {
            return Ok(());
        }
    }
    store(bench, &boards, base.into())?;
    bench.restart()?;
    Ok(())
}

pub fn rescue(bench: &mut Bench) -> Result<(), Stop> {
    if !DEVICE.rescue {
        bench
            .report
            .not_tried("rescue", "this firmware is without it (`with_rescue` in src/device.rs)");
        return Ok(());
    }
    // One after the other: boards at the same wrong rate would receive each other, and stay.
    for board in bench.boards.clone() {
        if !rescue_of(bench, board)? {
            break;
        }
    }
    Ok(())
}

/// Returns whether the board has its settings again.
fn rescue_of(bench: &mut Bench, board: Board) -> Result<bool, Stop> {
    /// The emergency error code of a board that is a guest at another rate.
    const GUEST: u16 = 0xFF10;
    let base = bench.base;
    let wrong = if base == BitRate::Kbit250 { BitRate::Kbit500 } else { BitRate::Kbit250 };
    if !store(bench, &[board], wrong.into())? {
        return Ok(false);
    }
    let id = board.id.get();
    bench.bus.nmt(RESET_NODE, id)?;
    let begin = Instant::now();
    bench.bus.take_unasked();
    let is_there = bench.reach(board.address, SEARCH)?;
    let seen = match is_there {
        true => format!(
            "answers at {} kbit/s after {:.1} s",
            base.kbit_per_s(),
            begin.elapsed().as_secs_f64()
        ),
        false => format!("no answer in {} s", SEARCH.as_secs()),
    };
    let what = format!("{board} with {} kbit/s stored", wrong.kbit_per_s());
    bench.report.expect(what, is_there, seen, "an answer at the rate of the bus");
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
    bench.report.expect(
        format!("{board}: emergency FF10h"),
        is_received || is_recorded,
        seen,
        "received",
    );
    for (sub_index, expected, name) in [
        (5, wrong.kbit_per_s(), "home rate"),
        (6, base.kbit_per_s(), "rate in use"),
        (7, 1, "rescues"),
    ] {
        let seen = bench.number(board, 0x2000, sub_index)?;
        let seen = seen.map_or_else(|failure| failure.to_string(), |number| number.to_string());
        bench.report.equal(
            format!("{board}: {name}, 2000h sub {sub_index}"),
            seen,
            &expected.to_string(),
        );
    }
    let is_stored = store(bench, &[board], base.into())?;
    bench.restart()?;
    Ok(is_stored)
}
