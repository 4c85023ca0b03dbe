//! Fastscan: all boards lose their node-IDs and are found again one by one.

use lss_slave::lss::{Address, FastscanStep, Request};

use crate::{
    bench::{BOOT, Bench, RESET_NODE},
    board,
    stop::Stop,
};

/// The number of scans: an answer that comes too late on a busy computer spoils one.
const ATTEMPTS: usize = 3;

pub fn run(bench: &mut Bench) -> Result<(), Stop> {
    for board in bench.boards.clone() {
        let is_selected = board::select(&mut bench.bus, board.address)?;
        let stored = match is_selected {
            true => board::store(&mut bench.bus, None, None)?,
            false => Err("it is not selected".into()),
        };
        if let Err(why) = stored {
            bench.report.failed(format!("{board}: un-configure and store"), why, "11 00, 17 00");
            return Ok(());
        }
    }
    bench.bus.request(Request::SwitchToWaiting)?;
    bench.bus.nmt(RESET_NODE, 0)?;
    bench.bus.pass(BOOT)?;
    let mut rest = bench.boards.clone();
    while !rest.is_empty() {
        let non_configured = bench.bus.ask(Request::IdentifyNonConfigured)?;
        let seen = non_configured.map_or("no answer".to_owned(), |answer| board::text(&answer));
        bench.report.equal(format!("4C, {} without a node-ID", rest.len()), seen, "50 00");
        let mut found = scan(bench)?;
        let mut attempt = 1;
        while found.is_err() && attempt < ATTEMPTS {
            attempt += 1;
            found = scan(bench)?;
        }
        let found = match found {
            Ok(address) => address,
            Err(why) => {
                bench.report.failed("Fastscan", why, "a board");
                return Ok(());
            }
        };
        let Some(at) = rest.iter().position(|board| board.address == found) else {
            bench.report.failed("Fastscan", format!("{found:08X?}"), "the address of a board");
            return Ok(());
        };
        let board = rest.remove(at);
        bench.report.passed("Fastscan", format!("finds {board} in attempt {attempt}"));
        let id = board.id.get();
        let stored = board::store(&mut bench.bus, Some(board.id), None)?;
        bench.report.equal(
            "11 and 17 after it",
            stored.err().unwrap_or_else(|| "stored".into()),
            "stored",
        );
        bench.bus.request(Request::SwitchToWaiting)?;
        let boot_up = bench.bus.wait_for(BOOT, |frame| {
            frame.cob_id() == 0x700 + u16::from(id) && frame.data() == [0]
        })?;
        let seen = if boot_up.is_some() { "a boot-up" } else { "no boot-up" };
        bench.report.equal("04 00 makes the node-ID active", seen.into(), "a boot-up");
    }
    let answer = bench.bus.probe(Request::IdentifyNonConfigured)?;
    let seen = answer.map_or("no answer".to_owned(), |answer| board::text(&answer));
    bench.report.equal("4C, all have a node-ID", seen, "no answer");
    Ok(())
}

/// Finds one board without a node-ID, which then is in LSS configuration state.
fn scan(bench: &mut Bench) -> Result<Result<Address, String>, Stop> {
    let mut parts = [0; 4];
    let begin = FastscanStep { id_number: 0, bit_check: 0x80, sub: 0, next: 0 };
    if bench.bus.ask(Request::Fastscan(begin))?.is_none() {
        return Ok(Err("51 80 is not answered".into()));
    }
    for sub in 0..4_u8 {
        let mut number = 0;
        for bit in (0..32).rev() {
            let step = FastscanStep { id_number: number, bit_check: bit, sub, next: sub };
            if bench.bus.probe(Request::Fastscan(step))?.is_none() {
                number |= 1 << bit;
            }
        }
        let last = FastscanStep { id_number: number, bit_check: 0, sub, next: (sub + 1) % 4 };
        if bench.bus.ask(Request::Fastscan(last))?.is_none() {
            return Ok(Err(format!(
                "part {sub} is not {number:08X}: an answer was lost or came too late"
            )));
        }
        parts[usize::from(sub)] = number;
    }
    let [vendor_id, product_code, revision_number, serial_number] = parts;
    Ok(Ok(Address { vendor_id, product_code, revision_number, serial_number }))
}
