//! SDO, NMT and heartbeat.

use std::time::Duration;

use crate::{
    bench::{BOOT, Bench, PRE_OPERATIONAL, RESET_COMMUNICATION, START, STOP},
    sdo,
    stop::Stop,
};

pub fn sdo(bench: &mut Bench) -> Result<(), Stop> {
    for board in bench.boards.clone() {
        let id = board.id.get();
        // Another product may have a fault on the bench.
        let error_register = bench.product.is_ours.then(|| "00000000".to_owned());
        for (index, sub_index, expected) in [
            (0x1000, 0, bench.product.device_type.map(|device_type| format!("{device_type:08X}"))),
            (0x1001, 0, error_register),
            (0x1018, 0, Some("00000004".into())),
            (0x2000, 6, Some(format!("{:08X}", bench.base.kbit_per_s()))),
            // Abort codes of CiA 301.
            (0x5FFF, 0, Some("abort 06020000".into())),
            (0x1018, 9, Some("abort 06090011".into())),
        ] {
            let Some(expected) = expected else { continue };
            let what = format!("{index:04X}h sub {sub_index}");
            if !expected.starts_with("abort") && bench.skips(board, &what, (index, sub_index))? {
                continue;
            }
            let seen = bench.shown(board, (index, sub_index), |number| format!("{number:08X}"))?;
            bench.report.equal(format!("{board}: {what}"), seen, &expected);
        }
        for (what, object, value, len, expected) in [
            ("write to a constant", (0x1000, 0), 1, 4, "abort 06010002"),
            ("write of another length", (0x1017, 0), 1, 4, "abort 06070012"),
            ("write out of range", (0x1029, 1), 3, 1, "abort 06090030"),
        ] {
            if bench.skips(board, what, object)? {
                continue;
            }
            let written = sdo::write(&mut bench.bus, id, object, value, len)?;
            let seen = written.map_or_else(|failure| failure.short(), |()| "written".to_owned());
            bench.report.equal(format!("{board}: {what}"), seen, expected);
        }
        heartbeat(bench, id)?;
    }
    Ok(())
}

/// The heartbeat keeps its time, and is not stored without 1010h.
fn heartbeat(bench: &mut Bench, id: u8) -> Result<(), Stop> {
    const PERIOD_MS: u16 = 100;
    const COUNT: u32 = 10;
    if let Err(failure) = bench.set_heartbeat(id, PERIOD_MS)? {
        bench.report.failed(format!("node {id}: write 1017h"), failure, "written");
        return Ok(());
    }
    let frames = bench.bus.collect(Duration::from_millis(u64::from(PERIOD_MS)) * (COUNT + 2))?;
    let cob_id = 0x700 + u16::from(id);
    let times: Vec<_> = frames
        .iter()
        .filter(|received| received.frame.cob_id() == cob_id)
        .map(|received| received.at)
        .collect();
    if times.len() < 2 {
        bench.report.failed(
            format!("node {id}: heartbeat of {PERIOD_MS} ms"),
            format!(
                "{} in {} ms, as by a port that does not report BusEvent::NonePending",
                times.len(),
                u32::from(PERIOD_MS) * (COUNT + 2)
            ),
            "one each time",
        );
        return Ok(());
    }
    let mean = match times.first().zip(times.last()) {
        Some((first, last)) if times.len() > 5 => {
            (*last - *first).as_secs_f64() * 1e3 / (times.len() - 1) as f64
        }
        _ => 0.0,
    };
    // A crystal is off by 0.5 % at most; the stamps have a resolution of 1 ms, and the computer's clock is jittery.
    bench.report.under("CiA 301, 7.2.8.3.2.2").expect(
        format!("node {id}: heartbeat of {PERIOD_MS} ms"),
        (mean - f64::from(PERIOD_MS)).abs() < 3.0,
        format!(
            "{mean:.1} ms, the mean of {}, by {}",
            times.len().saturating_sub(1),
            bench.bus.clock()
        ),
        format!("{PERIOD_MS} ms"),
    );
    Ok(())
}

pub fn nmt(bench: &mut Bench) -> Result<(), Stop> {
    // A heartbeat that comes soon shows the state.
    bench.set_heartbeats(50)?;
    for board in bench.boards.clone() {
        let id = board.id.get();
        for (command, name, state) in [
            (START, "start", 0x05),
            (PRE_OPERATIONAL, "enter pre-operational", 0x7F),
            (STOP, "stop", 0x04),
            (START, "start again", 0x05),
        ] {
            bench.bus.nmt(command, id)?;
            bench.bus.pass(Duration::from_millis(20) + 2 * bench.bus.latency())?;
            let cob_id = 0x700 + u16::from(id);
            let heartbeat =
                bench.bus.wait_for(bench.bus.patience(), |frame| frame.cob_id() == cob_id)?;
            let seen = heartbeat.map_or("no heartbeat".to_owned(), |heartbeat| {
                format!("state {:02X}", heartbeat.frame.data().first().copied().unwrap_or(0))
            });
            bench.report.equal(format!("{board}: NMT {name}"), seen, &format!("state {state:02X}"));
        }
        bench.bus.nmt(RESET_COMMUNICATION, id)?;
        bench.check_boot_up(&format!("{board}: NMT reset communication"), board.id, BOOT)?;
    }
    let words = ["a boot-up of each board", "a boot-up is missing"];
    let all = bench.restart()?;
    bench.report.either("NMT reset node to all", all, words);
    for board in bench.boards.clone() {
        let ms = |number| format!("{number} ms");
        let seen = bench.shown(board, (0x1017, 0), ms)?;
        let what = format!("{board}: the stored heartbeat time after the reset");
        bench.report.equal(what, seen, &ms(board.original.heartbeat_ms.into()));
    }
    Ok(())
}
