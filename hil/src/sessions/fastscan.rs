//! Fastscan: all boards lose their node-IDs and are found again one by one.

use canopen_node::lss::Request;
use lss_master::Fastscan;

use crate::{
    bench::{BOOT, Bench, RESET_NODE},
    board,
    stop::Stop,
};

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
        let found = match bench.bus.carry_out(Fastscan::new())? {
            Ok(Some(address)) => address,
            nobody => {
                let why =
                    nobody.err().map_or("51 80 is not answered".into(), |why| why.to_string());
                bench.report.failed("Fastscan", why, "a board");
                return Ok(());
            }
        };
        let Some(at) = rest.iter().position(|board| board.address == found) else {
            bench.report.failed("Fastscan", format!("{found:08X?}"), "the address of a board");
            return Ok(());
        };
        let board = rest.remove(at);
        bench.report.passed("Fastscan", format!("finds {board}"));
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
