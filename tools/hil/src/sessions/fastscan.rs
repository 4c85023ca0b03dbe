//! Fastscan: all boards lose their node-IDs and are found again one by one.

use canopen_node::lss::Request;
use lss_master::{Configure, Fastscan};

use crate::{
    bench::{BOOT, Bench, RESET_NODE},
    board,
    stop::Stop,
};

pub fn run(bench: &mut Bench) -> Result<(), Stop> {
    for board in bench.boards.clone() {
        let configure = Configure::node_id(None);
        if let Err(why) = board::store(&mut bench.bus, board.address, configure)? {
            bench.report.failed(format!("{board}: un-configure and store"), why, "11 00, 17 00");
            return Ok(());
        }
    }
    bench.bus.nmt(RESET_NODE, 0)?;
    bench.bus.pass(BOOT)?;
    let mut rest = bench.boards.clone();
    while !rest.is_empty() {
        let seen = board::answer_text(bench.bus.ask(Request::IdentifyNonConfigured)?);
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
        let stored = bench.bus.carry_out(Configure::node_id(Some(board.id)))?;
        let seen = stored.map_or_else(|why| why.to_string(), |()| "stored".into());
        bench.report.equal("11 and 17 after it", seen, "stored");
        bench.bus.request(Request::SwitchToWaiting)?;
        bench.check_boot_up("04 00 makes the node-ID active", board.id, BOOT)?;
    }
    let seen = board::answer_text(bench.bus.probe(Request::IdentifyNonConfigured)?);
    bench.report.equal("4C, all have a node-ID", seen, "no answer");
    Ok(())
}
