//! Fastscan: all boards lose their node-IDs and are found again one by one.

use canopen_node::lss::Request;
use lss_master::{Configure, Fastscan};

use crate::{
    bench::{BOOT, Bench, RESET_NODE},
    board,
    stop::Stop,
};

const NON_CONFIGURED: &str = "CiA 305, identify non-configured remote slave";

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
        let what = format!("identify non-configured, {} without a node-ID", rest.len());
        bench.report.under(NON_CONFIGURED).equal(what, seen, "50 00");
        let found = match bench.bus.carry_out(Fastscan::new())? {
            Ok(Some(address)) => address,
            nobody => {
                let why =
                    nobody.err().map_or("51 80 is not answered".into(), |why| why.to_string());
                bench.report.failed("Fastscan", why, "a board");
                return Ok(());
            }
        };
        let at = rest.iter().position(|board| board.address == found);
        let seen = at.map_or(format!("{found:08X?}"), |at| format!("finds {}", rest[at]));
        bench.report.expect("Fastscan", at.is_some(), seen, "the address of a board");
        let Some(at) = at else { return Ok(()) };
        let board = rest.remove(at);
        let stored = bench.bus.carry_out(Configure::node_id(Some(board.id)))?;
        let seen = stored.map_or_else(|why| why.to_string(), |()| "stored".into());
        let what = "configure node-ID and store configuration behind it";
        bench.report.under("CiA 305, store configuration").equal(what, seen, "stored");
        bench.bus.request(Request::SwitchToWaiting)?;
        bench.report.under("CiA 305, switch state global");
        bench.check_boot_up("LSS waiting state makes the node-ID active", board.id, BOOT)?;
    }
    let seen = board::answer_text(bench.bus.probe(Request::IdentifyNonConfigured)?);
    let what = "identify non-configured, all have a node-ID";
    bench.report.under(NON_CONFIGURED).equal(what, seen, "no answer");
    Ok(())
}
