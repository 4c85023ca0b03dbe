//! Every LSS service of CiA 305, with its refusals and silences.

use canopen_node::lss::{AddressPart, IdentifyKey, Request};

use crate::{
    bench::{BOOT, Bench, RESET_COMMUNICATION, RESET_NODE},
    board,
    stop::Stop,
};

pub fn run(bench: &mut Bench) -> Result<(), Stop> {
    let board = bench.boards[0];
    let address = board.address;
    let id = board.id.get();
    let base = bench.base.index();

    bench.bus.request(Request::SwitchToWaiting)?;
    bench.check_answer("inquire node-ID in LSS waiting state", &[0x5E], &[])?;
    bench.check_answer("configure node-ID in LSS waiting state", &[0x11, id], &[])?;
    for (part, number) in [
        (AddressPart::VendorId, address.vendor_id),
        (AddressPart::ProductCode, address.product_code),
        (AddressPart::SerialNumber, address.serial_number),
    ] {
        bench.bus.request(Request::Select(part, number))?;
    }
    bench.check_answer(
        "inquire node-ID after a selection without the revision number",
        &[0x5E],
        &[],
    )?;
    bench.check_answer("identify non-configured, all boards have a node-ID", &[0x4C], &[])?;
    let begin = &[0x51, 0, 0, 0, 0, 0x80];
    bench.check_answer("Fastscan begins, all boards have a node-ID", begin, &[])?;

    use IdentifyKey as Key;
    for (what, serial, expected) in [
        ("identify, exact serial number", address.serial_number, &[0x4F][..]),
        ("identify, another serial number", !address.serial_number, &[]),
    ] {
        bench.bus.request(Request::Identify(Key::VendorId, address.vendor_id))?;
        bench.bus.request(Request::Identify(Key::ProductCode, address.product_code))?;
        bench.bus.request(Request::Identify(Key::RevisionNumberLow, 0))?;
        bench.bus.request(Request::Identify(Key::RevisionNumberHigh, u32::MAX))?;
        bench.bus.request(Request::Identify(Key::SerialNumberLow, serial))?;
        let last = Request::Identify(Key::SerialNumberHigh, serial).to_bytes();
        bench.check_answer(what, &last, expected)?;
    }

    let is_selected = board::select(&mut bench.bus, address)?;
    bench.report.under("CiA 305, switch state selective").either(
        "switch state selective",
        is_selected,
        ["44", "no answer"],
    );
    bench.check_answer("inquire node-ID", &[0x5E], &[0x5E, id])?;
    for (what, request, expected) in [
        ("switch state global with mode 2", &[0x04, 2][..], &[][..]),
        ("an unknown command", &[0x7F], &[]),
        ("a request with the command of an answer", &[0x44], &[]),
        ("configure node-ID 0", &[0x11, 0], &[0x11, 1]),
        ("configure node-ID 128", &[0x11, 128], &[0x11, 1]),
        ("configure bit timing, another table", &[0x13, 1, 0], &[0x13, 1]),
        ("configure bit timing, the reserved index 5", &[0x13, 0, 5], &[0x13, 1]),
        ("configure bit timing, index 10", &[0x13, 0, 10], &[0x13, 1]),
        ("configure bit timing, the rate in use", &[0x13, 0, base], &[0x13, 0]),
        (
            "inquire node-ID with values in reserved bytes",
            &[0x5E, 1, 2, 3, 4, 5, 6, 7],
            &[0x5E, id],
        ),
        ("store configuration, unchanged", &[0x17], &[0x17, 0]),
    ] {
        bench.check_answer(what, request, expected)?;
    }
    bench.bus.send_to(0x7E5, &[0x5E])?;
    let answer = bench.bus.wait_for(bench.bus.short(), |frame| frame.cob_id() == 0x7E4)?;
    let report = bench.report.under("CiA 305, LSS protocols");
    report.either("a request of one byte", answer.is_none(), ["no answer", "an answer"]);

    node_id(bench)?;
    bench.bus.request(Request::SwitchToWaiting)?;
    bench.check_answer("inquire node-ID after the way back to LSS waiting state", &[0x5E], &[])?;
    Ok(())
}

/// A new node-ID takes effect at NMT reset communication, and is gone after NMT reset node if it was not stored.
fn node_id(bench: &mut Bench) -> Result<(), Stop> {
    let (board, other) = (bench.boards[0], bench.free_id());
    let id = board.id.get();
    bench.check_answer("configure another node-ID", &[0x11, other.get()], &[0x11, 0])?;
    bench.check_answer("inquire node-ID answers the active one", &[0x5E], &[0x5E, id])?;
    bench.bus.nmt(RESET_COMMUNICATION, id)?;
    bench.check_boot_up("the new node-ID after NMT reset communication", other, BOOT)?;
    bench.bus.nmt(RESET_NODE, other.get())?;
    let nodes = bench.boot_ups(BOOT)?;
    bench.report.expect(
        "the stored node-ID after NMT reset node",
        nodes.contains(&id),
        format!("boot-ups of {nodes:?}"),
        format!("[{id}]"),
    );
    bench.bus.heard.remove(&other.get());
    let _ = board::select(&mut bench.bus, board.address)?;
    Ok(())
}
