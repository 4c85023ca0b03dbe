//! Two slaves without a node-ID on a bus within the process: the master finds each and gives it a node-ID.

use std::convert::Infallible;

use lss_master::{Assign, Bus, Configure, Error, Fastscan, Instant, Master, Timing, run};
use lss_slave::{
    BitRate, BitRates, Frame, NodeId,
    lss::{Address, Reaction, Response, StateMachine},
};

fn main() -> Result<(), Error> {
    let slaves = [0xA, 0xB].map(slave);
    let mut network = Network { slaves, answers: Vec::new(), now: Instant::from_micros(0) };
    let mut master = Master::new(Timing::default());
    for node_id in 1..=127 {
        let configure = Configure::node_id(NodeId::new(node_id));
        let Ok(found) = run(&mut network, &mut master, Assign::scan(Fastscan::new(), configure));
        match found? {
            Some(address) => println!("node-ID {node_id}: {address:X?}"),
            None => break,
        }
    }
    Ok(())
}

/// The slaves on their bus, where a frame takes 1 ms.
struct Network {
    slaves: [StateMachine; 2],
    answers: Vec<Frame>,
    now: Instant,
}

impl Bus for Network {
    type Error = Infallible;

    fn now(&self) -> Instant {
        self.now
    }

    fn send(&mut self, request: &Frame) -> Result<(), Infallible> {
        self.now = self.now.plus_micros(1_000);
        self.answers = self.slaves.iter_mut().filter_map(|slave| receive(slave, request)).collect();
        // Slaves that answer together send one frame.
        self.answers.dedup();
        Ok(())
    }

    fn receive(
        &mut self,
        until: Instant,
        mut take: impl FnMut(&Frame, Instant),
    ) -> Result<(), Infallible> {
        if self.answers.is_empty() {
            self.now = until;
        }
        self.answers.drain(..).for_each(|answer| take(&answer, self.now));
        Ok(())
    }

    fn set_bit_rate(&mut self, _: BitRate) -> Result<(), Infallible> {
        Ok(())
    }
}

/// A slave whose LSS address ends with this serial number.
fn slave(serial_number: u32) -> StateMachine {
    let address = Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number };
    StateMachine::new(address, BitRates::possible(40_000_000), None, BitRate::Kbit125.into())
}

/// What the slave sends after a request.
fn receive(slave: &mut StateMachine, request: &Frame) -> Option<Frame> {
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
