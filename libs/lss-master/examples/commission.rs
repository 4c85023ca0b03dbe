//! Two slaves without a node-ID on a bus within the process: the master finds each and gives it a node-ID.

use lss_master::{Assign, Configure, Error, Fastscan, Instant, Master, Output, Timing};
use lss_slave::{
    BitRate, BitRates, Frame, NodeId,
    lss::{Address, Reaction, Response, Slave},
};

fn main() -> Result<(), Error> {
    let mut slaves = [0xA, 0xB].map(slave);
    let mut master = Master::new(Timing::default());
    let mut now = Instant::from_micros(0);
    for node_id in 1..=127 {
        let configure = Configure::node_id(NodeId::new(node_id));
        let mut session = master.start(Assign::scan(Fastscan::new(), configure));
        let found = loop {
            match session.poll(now) {
                Output::Transmit(request) => {
                    now = now.plus_micros(1_000);
                    let mut answers = Vec::new();
                    for slave in &mut slaves {
                        answers.extend(receive(slave, &request));
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
fn slave(serial_number: u32) -> Slave {
    let address = Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number };
    Slave::new(address, BitRates::possible(40_000_000), None, BitRate::Kbit125.into())
}

/// What the slave sends after a request.
fn receive(slave: &mut Slave, request: &Frame) -> Option<Frame> {
    match slave.handle(request.data().try_into().ok()?)? {
        Reaction::Answer(answer) => Some(answer),
        Reaction::StoreConfiguration => Some(Response::StoreConfiguration(Ok(())).to_frame()),
        Reaction::ResetCommunication => {
            slave.reset_communication();
            None
        }
        Reaction::ActivateBitTiming(_) => None,
    }
}
