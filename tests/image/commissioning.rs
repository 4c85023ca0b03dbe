//! Blank release images on one bus, commissioned by a master that waits no longer than the boards' answer time: how
//! close it comes to the limit of the bus.

use std::{
    env,
    io::{self, Write},
};

use canopen_node::{NodeId, lss::AddressPart};
use firmware::device::DEVICE;
use lss_master::{Assign, Configure, Fastscan, Master, Timing};
use testkit::lss_session::{carry_out, timing};

use crate::rig::*;

/// The number of boards: 8, or the value of `BOARDS`, up to 127.
fn boards() -> u8 {
    env::var("BOARDS").map_or(8, |text| text.parse().expect("BOARDS is a number up to 127"))
}

/// Gives all boards node-IDs from 1 on, and prints the time for each. `bits` is what each takes on the bus at least.
fn commission(bit_rate: BitRate, what: &str, scan: &Fastscan, floor_ms: f64) {
    let boards = boards();
    let blank = |number| board_with(number, settings(0xFF, bit_rate));
    let mut rig = ImageRig::new(bit_rate, (0..boards).map(blank));
    rig.network.record(Recording::Latest(1_000));
    // No other node sends, and the boards answer within 8 us.
    let answer = 1_000 + 640_000 / u32::from(bit_rate.kbit_per_s());
    let mut master = Master::new(Timing { answer, margin: 10, ..timing(bit_rate) });
    let mut assign = |rig: &mut ImageRig, node_id| {
        let assign = Assign::scan(scan.clone(), Configure::node_id(NodeId::new(node_id)));
        carry_out(&mut rig.network, rig.master, &mut master, assign).expect("answers in time")
    };
    let began = rig.network.now();
    let mut serials = Vec::new();
    for node_id in 1..=boards {
        let address = assign(&mut rig, node_id).expect("one more board");
        serials.push(address.serial_number);
        if serials.len().is_multiple_of(8) && boards > 16 {
            eprint!("\r{} of {boards} boards", serials.len());
            let _ = io::stderr().flush();
        }
    }
    let span = (rig.network.now() - began).as_us() as f64 / 1000.0;
    let each = span / f64::from(boards);
    println!(
        "{boards} boards at {} kbit/s, {what}: {:.2} s, {each:.1} ms a node, {:.2} of the floor ({floor_ms} ms)",
        bit_rate.kbit_per_s(),
        span / 1000.0,
        each / floor_ms,
    );
    assert_eq!(assign(&mut rig, 127), None);
    serials.sort_unstable();
    serials.dedup();
    assert_eq!(serials.len(), usize::from(boards), "each board has a node-ID of its own");
    assert!(each / floor_ms < 1.1, "{each} ms a node");
}

#[test]
fn blank_boards_with_unknown_serial_numbers_are_commissioned_at_bus_speed() {
    let scan = Fastscan::new()
        .with_known(AddressPart::VendorId, DEVICE.address.vendor_id)
        .with_known(AddressPart::ProductCode, DEVICE.address.product_code)
        .with_known(AddressPart::RevisionNumber, DEVICE.address.revision_number);
    commission(BitRate::Kbit1000, "serial number unknown", &scan, 10.9);
}

#[test]
fn unknown_blank_boards_are_commissioned_at_bus_speed() {
    commission(BitRate::Kbit1000, "nothing known", &Fastscan::new(), 36.8);
}

#[test]
fn unknown_blank_boards_are_commissioned_at_bus_speed_at_125_kbit_per_s() {
    commission(BitRate::Kbit125, "nothing known", &Fastscan::new(), 8.0 * 36.8);
}
