//! The boards' identity, by LSS and by SDO.

use std::time::Duration;

use canopen_node::{
    BitRate,
    lss::{Address, AddressPart, Request},
};

use crate::{bench::Bench, board, sdo, stop::Stop};

/// Finds the boards, and stops unless all nodes on the bus are boards of this product.
pub fn find(bench: &mut Bench) -> Result<(), Stop> {
    bench.report.progress("finding the boards by their serial numbers");
    bench.addresses = board::find_all(&mut bench.bus, &bench.product)?;
    if bench.addresses.is_empty() {
        return Err(Stop::Bench(
            "boards answered, but no serial number could be found: is a request lost?".into(),
        ));
    }
    let mut own = Vec::new();
    for address in bench.addresses.clone() {
        own.extend(board::node_id(&mut bench.bus, address)?);
    }
    bench.bus.request(Request::SwitchToWaiting)?;
    // Heartbeats come once a second by default.
    bench.bus.pass(Duration::from_millis(1100))?;
    let others: Vec<u8> =
        bench.bus.heard.keys().filter(|node| !own.contains(node)).copied().collect();
    for node in others {
        let mut parts = [0; 4];
        for (part, sub_index) in parts.iter_mut().zip(1..) {
            *part = sdo::read_number(&mut bench.bus, node, 0x1018, sub_index)?.unwrap_or(0);
        }
        let [vendor_id, product_code, revision_number, serial_number] = parts;
        if (vendor_id, product_code) != (bench.product.vendor_id, bench.product.product_code)
            || serial_number == 0
        {
            return Err(Stop::Bench(format!(
                "not our board: node {node} with vendor-ID {vendor_id:08X} and product code {product_code:08X} is on \
                 the bus too. Take it off: the sessions change the bit rate of the whole bus. Nothing was changed"
            )));
        }
        // An answer came too late to be found.
        bench.addresses.push(Address { vendor_id, product_code, revision_number, serial_number });
    }
    Ok(())
}

/// Checks the identity of each board.
pub fn check(bench: &mut Bench) -> Result<(), Stop> {
    for board in bench.boards.clone() {
        let address = board.address;
        let parts = [
            (AddressPart::VendorId, address.vendor_id, "vendor-ID"),
            (AddressPart::ProductCode, address.product_code, "product code"),
            (AddressPart::RevisionNumber, address.revision_number, "revision number"),
            (AddressPart::SerialNumber, address.serial_number, "serial number"),
        ];
        let is_selected = board::select(&mut bench.bus, address)?;
        let what = format!("{board}: switch state selective");
        bench.report.under("CiA 305, switch state selective").either(
            what,
            is_selected,
            ["44", "no answer"],
        );
        for (at, (part, number, name)) in parts.into_iter().enumerate() {
            let answer = bench.bus.ask(Request::Inquire(part))?;
            let by_lss = answer.filter(|answer| answer[0] == 0x5A + at as u8);
            let by_lss =
                by_lss.map(|bytes| u32::from_le_bytes([bytes[1], bytes[2], bytes[3], bytes[4]]));
            let by_sdo = bench.number(board, 0x1018, at as u8 + 1)?;
            let hex = |number: u32| format!("{number:08X}");
            let is_equal = by_lss == Some(number) && by_sdo == Ok(number);
            let by_lss = by_lss.map_or("no answer".into(), hex);
            let by_sdo = by_sdo.map_or_else(|failure| failure, hex);
            let seen = format!("{by_lss} by LSS, {by_sdo} by SDO");
            bench.report.expect(format!("{board}: {name}"), is_equal, seen, hex(number));
        }
        if let Some(revision_number) = bench.product.revision_number {
            bench.report.equal(
                format!("{board}: revision number of {}", bench.product.source),
                format!("{:08X}", address.revision_number),
                &format!("{revision_number:08X}"),
            );
        }
        let texts = bench.product.texts.clone();
        for ((index, name), expected) in
            [(0x1008, "device name"), (0x1009, "hardware version"), (0x100A, "software version")]
                .into_iter()
                .zip(texts)
        {
            let Some(expected) = expected else { continue };
            let text = sdo::read(&mut bench.bus, board.id.get(), index, 0)?;
            let seen = text.map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
            let seen = seen.unwrap_or_else(|failure| failure.short());
            let what = format!("{board}: {name}");
            bench.report.under("CiA 301, 7.5.2.8 to 7.5.2.10").equal(what, seen, &expected);
        }
    }
    if let Some(rates) = &bench.product.rates {
        let list = |rates: &[BitRate]| {
            let rates: Vec<_> = rates.iter().map(|rate| rate.kbit_per_s().to_string()).collect();
            format!("{} kbit/s", rates.join(", "))
        };
        let (seen, rates) = (list(&bench.offered), list(rates));
        let report = bench.report.under("CiA 305, configure bit timing parameters");
        report.equal("bit rates that LSS accepts", seen, &rates);
    }
    bench.bus.request(Request::SwitchToWaiting)
}
