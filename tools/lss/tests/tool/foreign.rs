//! Slaves of others, with the faults that people meet, on a bus within the process.

use std::{fs, path::Path, sync::Arc};

use canopen_node::{BitRate, NodeId, Settings, lss::Address};
use testkit::{
    flash::BoardFlash,
    node_rig::{ADDRESS, NodeRig, device},
    random::Random,
    slave_bus::{BusAdapter, Habits, SlaveBus},
};

use crate::emulated::{Outcome, run, text};

struct Slaves {
    adapter: BusAdapter,
}

impl Slaves {
    /// Slaves without a node-ID at 125 kbit/s, with random serial numbers, and these habits.
    fn new(habits: impl IntoIterator<Item = Habits>) -> Self {
        let mut random = Random::from_environment();
        let mut slaves = Vec::new();
        for habits in habits {
            let address = Address { serial_number: random.u32() | 1, ..ADDRESS };
            let defaults = Settings::new(BitRate::Kbit125.into()).with_heartbeat_ms(1000);
            let device = device(address).with_defaults(defaults);
            slaves.push((NodeRig::with_device(device, BoardFlash::blank(0), 0), habits));
        }
        let random = Random::from_seed(random.u64());
        Self { adapter: BusAdapter::new(SlaveBus::new(slaves, random)) }
    }

    /// Runs `lss`.
    fn lss(&self, arguments: &str) -> Outcome {
        run(Box::new(self.adapter.clone()), &Arc::default(), arguments, |_| ())
    }

    /// Runs `lss`, which must succeed; returns what it prints.
    #[track_caller]
    fn done(&self, arguments: &str) -> String {
        let outcome = self.lss(arguments);
        assert_eq!(outcome.code, 0, "{}", outcome.error);
        outcome.text
    }

    /// Asserts that each slave has a node-ID of its own and has stored it.
    #[track_caller]
    fn assert_assigned(&self) {
        let bus = self.adapter.bus();
        let ids = bus.slaves.iter().map(|slave| slave.rig.node.node_id());
        let mut ids: Vec<u8> = ids.flatten().map(NodeId::get).collect();
        ids.sort_unstable();
        let all: Vec<u8> = (1..=bus.slaves.len() as u8).collect();
        assert_eq!(ids, all);
        for slave in &bus.slaves {
            let stored = slave.rig.stored().expect("it has stored");
            assert_eq!(stored.node_id, slave.rig.node.node_id());
        }
    }

    fn address(&self, slave: usize) -> String {
        text(self.adapter.bus().slaves[slave].rig.node.lss().address())
    }
}

fn slow(ms: u64) -> Habits {
    Habits { answer_us: ms * 900..ms * 1_000, ..Habits::default() }
}

fn one_frame(poll_ms: u64) -> Habits {
    Habits { poll_us: poll_ms * 1_000, ..Habits::default() }
}

/// What a person does with new boards; the last slave is inquired and gets another node-ID.
#[track_caller]
fn assert_served(slaves: &Slaves) {
    let count = slaves.adapter.bus().slaves.len();
    slaves.done("assign");
    slaves.assert_assigned();
    let last = slaves.address(count - 1);
    assert!(slaves.done(&format!("inquire --address {last}")).contains(&last));
    assert_eq!(slaves.done("list").lines().count(), 1 + count);
    let text = slaves.done("set-rate 250");
    assert!(text.contains(&format!("all {count} boards answer at 250 kbit/s and have stored it")));
    let set = format!("set-id 99 --store --reset --bit-rate 250 --address {last}");
    assert!(slaves.done(&set).contains("node-ID 99, stored"));
}

#[test]
fn slow_slaves_are_served_and_the_person_is_told_how_slow_they_are() {
    let slaves = Slaves::new([slow(300), slow(40), Habits::default()]);
    let outcome = slaves.lss("assign");
    assert_eq!(outcome.code, 0, "{}", outcome.error);
    slaves.assert_assigned();
    let told = outcome.slow_answer.expect("it is told");
    assert!((270..=320).contains(&told.as_millis()), "{told:?}");
    assert_served(&Slaves::new([slow(300), Habits::default()]));
    let outcome = Slaves::new([Habits::default(), slow(10)]).lss("assign");
    assert_eq!(outcome.slow_answer, None);
}

#[test]
fn slaves_that_hold_one_frame_are_served() {
    for poll_ms in [1, 10] {
        assert_served(&Slaves::new([one_frame(poll_ms)]));
        assert_served(&Slaves::new([Habits::default(), one_frame(poll_ms), one_frame(poll_ms)]));
    }
}

#[test]
fn slaves_that_hold_one_frame_are_identified() {
    let slaves = Slaves::new([one_frame(1), one_frame(1)]);
    let Address { vendor_id, product_code, .. } = ADDRESS;
    let product = format!("--vendor {vendor_id} --product {product_code}");
    slaves.done(&format!("identify {product}"));
    let each = slaves.done(&format!("identify {product} --each"));
    assert_eq!(each.lines().count(), 2, "{each}");
}

#[test]
fn slaves_that_answer_again_late_are_served() {
    for again_us in [300, 5_000, 30_000] {
        let again = || Habits { again_us, ..Habits::default() };
        assert_served(&Slaves::new([again(), Habits::default(), again()]));
    }
}

#[test]
fn slaves_without_identify_are_served() {
    // Identify remote slave and identify non-configured remote slave.
    let without = &[0x46, 0x47, 0x48, 0x49, 0x4A, 0x4B, 0x4C];
    assert_served(&Slaves::new([(); 2].map(|()| Habits { without, ..Habits::default() })));
}

#[test]
fn slaves_without_a_boot_up_message_get_a_node_id() {
    let slaves = Slaves::new([Habits { boot_up: 0x7F, ..Habits::default() }]);
    let text = slaves.done("assign");
    assert!(text.contains("stored; it answers after a reset, but sends no boot-up message"));
    slaves.assert_assigned();
}

#[test]
fn slaves_without_fastscan_are_found_by_identify_if_the_product_is_known() {
    let without = &[0x51];
    let table = Path::new(env!("CARGO_TARGET_TMPDIR")).join("without-fastscan.toml");
    // Whether the slaves answer at the same moment is a matter of chance.
    for _ in 0..6 {
        let slaves = Slaves::new([(); 3].map(|()| Habits { without, ..Habits::default() }));
        let outcome = slaves.lss("assign");
        assert_eq!(outcome.code, 1);
        assert!(outcome.error.contains("does not answer to Fastscan"), "{}", outcome.error);
        let known = slaves.address(1);
        fs::write(&table, format!("[[node]]\nid = 2\naddress = \"{known}\"\n")).expect("a table");
        slaves.done(&format!("assign --table {}", table.display()));
        slaves.assert_assigned();
    }
}
