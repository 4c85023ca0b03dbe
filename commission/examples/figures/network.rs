//! Slaves on a bus within the process, and the outcome of a command there.

use std::{sync::Arc, time::Duration};

use can_bus::bus::Bus;
use canopen_node::{BitRate, NodeId, Settings, lss::Address};
use clap::Parser;
use commission::{Arguments, Session};
use testkit::{
    flash::BoardFlash,
    node_rig::{NodeRig, device},
    random::Random,
    slave_bus::{BusAdapter, Habits, SlaveBus},
};

/// The slaves, and the tool's adapter.
pub struct Network {
    pub adapter: BusAdapter,
}

/// The outcome of a command.
pub struct Outcome {
    pub text: String,
    pub code: u8,
    pub error: String,
    /// The virtual time that it took, in microseconds.
    pub us: u64,
}

/// The LSS address of the slaves but for its serial number.
pub const ADDRESS: Address = Address {
    vendor_id: 0x0000_0360,
    product_code: 0x4C53_5334,
    revision_number: 0x0001_0000,
    serial_number: 0,
};

/// A slave with supervision of the bit rate.
pub fn slave(address: Address, node_id: u8, rate: BitRate) -> NodeRig {
    let settings = Settings::new(rate.into())
        .with_node_id(NodeId::from_lss(node_id).expect("1..=127 or FF"))
        .with_heartbeat_ms(1000);
    let device = device(address).with_rescue(true).with_defaults(settings);
    NodeRig::with_device(device, BoardFlash::blank(0), 0)
}

impl Network {
    /// Slaves of ours with these node-IDs, FF: none, and others.
    pub fn new(
        random: &mut Random,
        rate: BitRate,
        node_ids: &[u8],
        others: &[(NodeRig, Habits)],
    ) -> Self {
        let _ = others;
        let mut ours = Vec::new();
        for id in node_ids {
            let address = Address { serial_number: random.u32(), ..ADDRESS };
            ours.push((slave(address, *id, rate), Habits::default()));
        }
        let bus = SlaveBus::new(ours, Random::from_seed(random.u64()));
        Self { adapter: BusAdapter::new(bus) }
    }

    /// Runs `lss` with these arguments.
    pub fn lss(&self, arguments: &str) -> Outcome {
        let words = ["lss"].into_iter().chain(arguments.split_whitespace());
        let arguments = Arguments::try_parse_from(words).expect("a command line");
        let latency = Duration::from_millis(arguments.latency.into());
        let bus = Bus::new(Box::new(self.adapter.clone()), latency, Arc::default());
        let mut out = Vec::new();
        let begin = self.adapter.bus().now();
        let outcome = Session::new(bus, &mut out, false).run(&arguments);
        let us = self.adapter.bus().now() - begin;
        let text = String::from_utf8(out).expect("UTF-8");
        let (code, error) = match outcome {
            Ok(()) => (0, String::new()),
            Err(failure) => (failure.exit_code(), failure.to_string()),
        };
        Outcome { text, code, error, us }
    }
}
