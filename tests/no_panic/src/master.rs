//! An LSS master with unknown answers and values.

use core::hint::black_box;

use canopen_node::{
    BitRate, Frame, NodeId,
    lss::{Address, AddressPart, Request},
};
use lss_master::{
    Assign, Configure, Fastscan, Find, Identify, InquireAddress, InquireNodeId, Master, Member,
    Procedure, Select, SwitchBitRate, Timing,
};

use super::{any, any_instant, any_number};

pub fn command() {
    let address = Address::from([any_number(), any_number(), any_number(), any_number()]);
    carry_out(any(Request::StoreConfiguration));
    carry_out(Select(address));
    carry_out(InquireNodeId);
    carry_out(InquireAddress::new());
    let ranges = Identify {
        revision_numbers: any_number()..=any_number(),
        serial_numbers: any_number()..=any_number(),
        ..Identify::product(any_number(), any_number())
    };
    carry_out(Find::new(ranges.clone()));
    carry_out(ranges);
    carry_out(Identify::address(address));

    let scan = Fastscan::new().with_known(any(AddressPart::SerialNumber), any_number());
    let configure =
        Configure::node_id(NodeId::new(any(0))).with_bit_rate(any(BitRate::Kbit10).into());
    carry_out(Assign::scan(scan, any(configure)));
    carry_out(Assign::address(address, any(configure)));
    let mut members = any([Member::new(address); 3]);
    carry_out(SwitchBitRate::new(&mut members, any(BitRate::Kbit10), any(BitRate::Kbit20), any(0)));
}

/// Between the calls the session is in any state that its types allow.
fn carry_out<P: Procedure>(procedure: P) {
    let timing = Timing {
        answer: any_number(),
        store: any_number(),
        margin: any_number(),
        gap: any_number(),
    };
    let mut master = any(Master::new(timing));
    let mut session = master.start(procedure);
    while any(true) {
        let _ = black_box(black_box(&mut session).poll(any_instant()));
        if let Some(frame) = Frame::from_padded(any(0), any(0), any([0; 8])) {
            black_box(&mut session).handle_frame(&any(frame), any_instant());
        }
    }
}
