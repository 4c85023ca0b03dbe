//! The SDO server through the node: any request has at most one answer, of eight bytes, with the node's COB-ID.

#![no_main]

use libfuzzer_sys::fuzz_target;
use canopen_node::{
    Action, BitRate, BitRates, Device, Frame, Instant, Node, NodeId, Settings, lss::Address,
};

const NOW: Instant = Instant::from_micros(0);
const ABORT: u8 = 0x80;

fn node() -> Node {
    let address = Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number: 4 };
    let device = Device::new(address, BitRates::possible(40_000_000))
        .with_name("A name that takes more than one segment")
        .with_versions("", "1.2.34.5");
    let settings = Settings::new(BitRate::Kbit1000.into()).with_node_id(NodeId::new(5));
    Node::new(device, Some(settings))
}

fuzz_target!(|requests: Vec<[u8; 8]>| {
    let mut node = node();
    let mut answers = 0;
    let mut stores = 0;
    let boot_up = node.poll(NOW);
    assert!(matches!(boot_up, Some(Action::Transmit(frame)) if frame.cob_id() == 0x705));
    for request in &requests {
        let frame = Frame::new(0x605, request).expect("eight bytes");
        let at_once = node.handle_frame(&frame, NOW);
        let mut action = at_once.or_else(|| node.poll(NOW));
        while let Some(now) = action {
            match now {
                Action::Transmit(answer) if answer.cob_id() == 0x585 => {
                    assert_eq!(answer.data().len(), 8);
                    assert_ne!(request[0], ABORT, "an abort is answered");
                    answers += 1;
                }
                // A heartbeat, once its time has been written.
                Action::Transmit(other) => assert_eq!(other.cob_id(), 0x705),
                Action::Store(_) => {
                    stores += 1;
                    node.handle_stored(Ok(()));
                }
                other => panic!("{other:?} by SDO"),
            }
            action = node.poll(NOW);
        }
    }
    assert!(answers <= requests.len());
    assert!(stores <= requests.len());
});
