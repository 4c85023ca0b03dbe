//! Slaves of others, with the faults that people meet, on a bus within the process.

use std::{fs, sync::Arc};

use canopen_node::{BitRate, NodeId, Settings, lss::Address};
use testkit::{
    cargo,
    flash::BoardFlash,
    node_rig::{ADDRESS, NodeRig, device},
    random::Random,
    slave_bus::{BusAdapter, Firmware, Habits, Slave, SlaveBus},
};

use crate::emulated::{Outcome, run, text};

struct Slaves {
    adapter: BusAdapter,
}

impl Slaves {
    /// Slaves without a node-ID at 125 kbit/s, with random serial numbers, and these habits.
    fn new(habits: impl IntoIterator<Item = Habits>) -> Self {
        let mut random = Random::from_environment();
        let habits: Vec<_> = habits.into_iter().map(|habits| (random.u32() | 1, habits)).collect();
        Self::with_serial_numbers(habits, &mut random)
    }

    /// The same with these serial numbers.
    fn with_serial_numbers(habits: Vec<(u32, Habits)>, random: &mut Random) -> Self {
        let mut slaves = Vec::new();
        for (serial_number, habits) in habits {
            let address = Address { serial_number, ..ADDRESS };
            let defaults = Settings::new(BitRate::Kbit125.into());
            let device = device(address).with_defaults(defaults).with_heartbeat_ms(1000);
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
    let boards = if count == 1 { "1 board".into() } else { format!("{count} boards") };
    assert!(text.ends_with(&format!("{boards} answered at 250 kbit/s and stored it\n")), "{text}");
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
fn a_slave_that_holds_one_frame_is_not_missing_beside_one_that_is() {
    let slaves = Slaves::new([one_frame(10)]);
    let table = cargo::scratch("one-frame.toml");
    let node = |id: u8, address: &str| format!("[[node]]\nid = {id}\naddress = \"{address}\"\n");
    let text = node(1, "00000001:00000002:00000003:00000004") + &node(2, &slaves.address(0));
    fs::write(&table, text).expect("a table");
    let outcome = slaves.lss(&format!("assign --table {}", table.display()));
    let missing = "node 1 of the table is missing: 00000001:00000002:00000003:00000004";
    assert_eq!((outcome.code, &*outcome.error), (1, missing));
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
    let without: &[u8] = &[0x51];
    let table = cargo::scratch("without-fastscan.toml");
    let assign = |slaves: &Slaves| {
        let known = slaves.address(1);
        fs::write(&table, format!("[[node]]\nid = 2\naddress = \"{known}\"\n")).expect("a table");
        slaves.lss(&format!("assign --table {}", table.display()))
    };
    let words = "does not answer to Fastscan";
    // Whether the slaves answer at the same moment is a matter of chance.
    for _ in 0..6 {
        let slaves = Slaves::new([(); 3].map(|()| Habits { without, ..Habits::default() }));
        let outcome = slaves.lss("assign");
        assert_eq!(outcome.code, 1);
        assert!(outcome.error.contains(words), "{}", outcome.error);
        assert_eq!(assign(&slaves).code, 0);
        slaves.assert_assigned();
    }
    // The last one does not support identify remote slave either.
    let habits = [without, without, &[0x46, 0x47, 0x48, 0x49, 0x4A, 0x4B, 0x51]];
    let outcome =
        assign(&Slaves::new(habits.map(|without| Habits { without, ..Habits::default() })));
    assert_eq!((outcome.code, outcome.text.lines().count()), (1, 2), "{}", outcome.text);
    assert!(outcome.error.contains(words), "{}", outcome.error);
}

#[test]
fn a_device_that_answers_every_fastscan_question_ends_the_scan() {
    let claims_all = || Habits { claims_all: true, ..Habits::default() };
    for habits in [vec![claims_all()], vec![Habits::default(), claims_all()]] {
        for (command, words) in [
            ("list", "more than 127 boards answer to Fastscan"),
            ("set-rate 500", "more than 127 boards answer to Fastscan"),
            ("assign", "more than 127 boards answer to Fastscan"),
        ] {
            let slaves = Slaves::new(habits.clone());
            let outcome = slaves.lss(command);
            assert_eq!(outcome.code, 1);
            assert!(outcome.error.starts_with(words), "{}", outcome.error);
            let ms = slaves.adapter.bus().now() / 1_000;
            assert!(ms < 25_000, "{ms} ms");
        }
    }
}

#[test]
fn a_device_that_answers_every_identify_question_ends_the_search() {
    let slaves = Slaves::new([Habits { claims_all: true, ..Habits::default() }]);
    let outcome = slaves.lss("identify --vendor 1 --product 2 --each");
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.starts_with("more than 127 boards"), "{}", outcome.error);
}

#[test]
fn two_boards_with_one_lss_address_are_no_success() {
    // Answers at the same moment would be one frame.
    let takes =
        |us: u64| Habits { answer_us: us..us + 1, other_us: us..us + 1, ..Habits::default() };
    let habits = vec![(1, takes(100)), (1, takes(250))];
    let slaves = Slaves::with_serial_numbers(habits, &mut Random::from_seed(1));
    let listed = slaves.lss("list");
    assert_eq!((listed.code, listed.twice), (0, vec![1]), "the boards have no node-ID yet");
    let outcome = slaves.lss("assign");
    assert_eq!((outcome.code, outcome.twice), (1, vec![1]));
    let (address, one) = (slaves.address(0), NodeId::new(1));
    let words = format!("2 boards have the LSS address {address}, and both are node 1");
    assert!(outcome.error.contains(&words), "{}", outcome.error);
    assert!(!outcome.text.contains("verified"), "{}", outcome.text);
    let is_stored = |slave: &Slave| slave.rig.stored().is_some_and(|own| own.node_id == one);
    assert!(slaves.adapter.bus().slaves.iter().all(is_stored), "they keep the node-ID in use");
    // The next runs see it, too.
    let table = cargo::scratch("twins.toml");
    let entry = format!("[[node]]\nid = 1\naddress = \"{address}\"\n");
    fs::write(&table, entry).expect("a table");
    let commands = ["list", "assign", "set-rate 500"].map(str::to_owned);
    let with_table = ["apply", "assign --table"].map(|name| format!("{name} {}", table.display()));
    for command in commands.iter().chain(&with_table) {
        let outcome = slaves.lss(command);
        assert_eq!(outcome.code, 1, "{command}");
        assert!(outcome.error.contains(&words), "{command}: {}", outcome.error);
    }
    // An adapter that delivers both answers at one moment is not taken for one that doubles frames.
    let gathers = Firmware { gathers: true, ..Firmware::FTDI };
    let adapter = slaves.adapter.with_firmware(gathers).expect("it is an adapter");
    let outcome = run(adapter, &Arc::default(), "list", |_| ());
    assert!(outcome.error.contains(&words), "{}", outcome.error);
}

#[test]
fn a_board_that_answers_twice_is_not_taken_for_two_boards() {
    for again_us in [300, 5_000] {
        let habits = Habits { again_us, other_us: 50..900, ..Habits::default() };
        let slaves = Slaves::new([habits.clone(), habits]);
        slaves.done("assign");
        slaves.assert_assigned();
        slaves.done("list");
    }
}

#[test]
fn a_board_whose_answers_are_too_short_is_told() {
    let Address { vendor_id, product_code, .. } = ADDRESS;
    let identify = format!("identify --vendor {vendor_id} --product {product_code}");
    for answer_bytes in [1, 5] {
        let short = || Habits { answer_bytes, ..Habits::default() };
        for habits in [vec![short()], vec![Habits::default(), short()]] {
            for command in ["list", "assign", "find --ask", &identify] {
                let outcome = Slaves::new(habits.clone()).lss(command);
                assert_eq!(outcome.code, 1, "{command}");
                let words = format!(
                    "a device answers LSS requests with {answer_bytes} bytes, and not with 8"
                );
                assert!(outcome.error.contains(&words), "{command}: {}", outcome.error);
            }
        }
    }
}
