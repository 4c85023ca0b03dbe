//! Two slaves without a node-ID on a bus within the process: the master finds each, and it boots up with a node-ID.

use lss_master::{Assign, Configure, Error, Fastscan, Instant, Master, Output, Timing};
use lss_slave::{Action, BitRate, BitRates, Device, Frame, Node, NodeId, Settings, lss::Address};

fn main() -> Result<(), Error> {
    let mut slaves = [0xA, 0xB].map(slave);
    let mut master = Master::new(Timing::default());
    let mut now = Instant::from_micros(0);
    for node_id in 1.. {
        let configure = Configure::node_id(NodeId::new(node_id));
        let mut session = master.start(Assign::scan(Fastscan::new(), configure));
        let found = loop {
            match session.poll(now) {
                Output::Transmit(request) => {
                    now = now.plus_micros(1_000);
                    let mut answers = Vec::new();
                    for slave in &mut slaves {
                        answers.extend(receive(slave, &request, now));
                    }
                    // Slaves that answer together send one frame.
                    answers.dedup();
                    for answer in answers {
                        session.handle_frame(&answer, now);
                    }
                }
                Output::Wait(until) => now = until,
                Output::SetBitRate(_) => {}
                Output::Done(found) => break found?,
            }
        };
        match found {
            Some(address) => println!("node-ID {node_id}: {address:X?}"),
            None => break,
        }
    }
    Ok(())
}

/// A slave whose LSS address ends with this serial number.
fn slave(serial_number: u32) -> Node {
    let address = Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number };
    let device = Device::new(address, BitRates::possible(40_000_000))
        .with_defaults(Settings::new(BitRate::Kbit125.into()));
    Node::new(device, None)
}

/// What the slave sends after a frame.
fn receive(slave: &mut Node, frame: &Frame, now: Instant) -> Vec<Frame> {
    let mut sent = Vec::new();
    let mut first = slave.handle_frame(frame, now);
    while let Some(action) = first.take().or_else(|| slave.poll(now)) {
        match action {
            Action::Transmit(frame) => sent.push(frame),
            Action::Store(_) => slave.handle_stored(Ok(())),
            _ => {}
        }
    }
    sent
}
