//! Slaves on a bus within the process, and the outcome of a command there.

use std::{
    collections::BTreeSet,
    io::{self, Write},
    sync::Arc,
    time::Duration,
};

use can_bus::bus::Bus;
use canopen_node::{BitRate, NodeId, Settings, lss::Address};
use clap::Parser;
use lss::{Arguments, Session};
use testkit::{
    flash::BoardFlash,
    node_rig::{NodeRig, device},
    random::Random,
    slave_bus::{BusAdapter, Habits, SlaveBus},
};

/// The LSS address of the slaves but for its serial number.
pub const ADDRESS: Address = Address {
    vendor_id: 0x0000_0360,
    product_code: 0x4C53_5334,
    revision_number: 0x0001_0000,
    serial_number: 0,
};
/// The node-ID of a slave without one.
pub const NONE: u8 = 0xFF;

/// The slaves, and the tool's adapter.
pub struct Network {
    pub adapter: BusAdapter,
}

/// The outcome of a command.
#[derive(Debug)]
pub struct Outcome {
    pub text: String,
    pub code: u8,
    pub error: String,
    /// The virtual time that it took, in microseconds.
    pub us: u64,
    /// That until it printed the last node that is as in the table.
    pub us_to_last_known: u64,
}

/// A slave with supervision of the bit rate.
pub fn slave(address: Address, node_id: u8, rate: BitRate) -> NodeRig {
    let settings = Settings::new(rate.into())
        .with_node_id(NodeId::from_lss(node_id).expect("1..=127 or FF"))
        .with_heartbeat_ms(1000);
    let device = device(address).with_rescue(true).with_defaults(settings);
    NodeRig::with_device(device, BoardFlash::blank(0), 0)
}

/// Slaves of ours with these node-IDs, FF: none.
pub fn ours(random: &mut Random, rate: BitRate, node_ids: &[u8]) -> Vec<(NodeRig, Habits)> {
    let mut slaves = Vec::new();
    for id in node_ids {
        let address = Address { serial_number: random.u32() | 1, ..ADDRESS };
        slaves.push((slave(address, *id, rate), Habits::default()));
    }
    slaves
}

impl Network {
    pub fn new(slaves: Vec<(NodeRig, Habits)>, random: &mut Random) -> Self {
        Self { adapter: BusAdapter::new(SlaveBus::new(slaves, Random::from_seed(random.u64()))) }
    }

    /// Runs `lss` with these arguments, by an adapter without a latency of its own.
    pub fn lss(&self, arguments: &str) -> Outcome {
        let words = ["lss", "--latency", "0"].into_iter().chain(arguments.split_whitespace());
        let arguments = Arguments::try_parse_from(words).expect("a command line");
        let bus = Bus::new(Box::new(self.adapter.clone()), Duration::ZERO, Arc::default());
        let begin = self.adapter.bus().now();
        let mut out = Timed { adapter: self.adapter.clone(), text: Vec::new(), last_known: begin };
        let outcome = Session::new(bus, &mut out, false).run(&arguments);
        let (code, error) = match outcome {
            Ok(()) => (0, String::new()),
            Err(failure) => (failure.exit_code(), failure.to_string()),
        };
        Outcome {
            text: String::from_utf8(out.text).expect("UTF-8"),
            code,
            error,
            us: self.adapter.bus().now() - begin,
            us_to_last_known: out.last_known - begin,
        }
    }

    /// Lets time pass.
    pub fn pass_ms(&self, ms: u64) {
        let mut bus = self.adapter.bus();
        let until = bus.now() + ms * 1_000;
        while bus.run(until).is_some() {}
    }

    /// The LSS addresses of the slaves.
    pub fn addresses(&self) -> Vec<Address> {
        self.adapter.bus().slaves.iter().map(|slave| slave.rig.node.lss().address()).collect()
    }

    /// The active node-ID of each slave, all of which have power.
    pub fn active(&self) -> Vec<Option<NodeId>> {
        self.adapter.bus().slaves.iter().map(|slave| slave.rig.node.node_id()).collect()
    }

    /// The node-IDs that several slaves have.
    pub fn active_shared(&self) -> BTreeSet<u8> {
        twice(self.active())
    }

    /// The node-IDs that several slaves have, or have stored.
    pub fn shared(&self) -> BTreeSet<u8> {
        let mut shared = self.active_shared();
        let bus = self.adapter.bus();
        shared.extend(twice(bus.slaves.iter().map(|slave| slave.rig.stored()?.node_id)));
        shared
    }
}

fn twice(ids: impl IntoIterator<Item = Option<NodeId>>) -> BTreeSet<u8> {
    let mut seen = BTreeSet::new();
    ids.into_iter().flatten().map(NodeId::get).filter(|id| !seen.insert(*id)).collect()
}

/// What a command prints, and when.
struct Timed {
    adapter: BusAdapter,
    text: Vec<u8>,
    last_known: u64,
}

impl Write for Timed {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.text.extend(bytes);
        if self.text.ends_with(b"as in the table\n") {
            self.last_known = self.adapter.bus().now();
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
