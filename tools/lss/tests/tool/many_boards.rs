//! Large networks of slaves in the process at 1 Mbit/s: how long they take, and what faults do to them.

use std::{
    cell::Cell,
    collections::BTreeSet,
    fs,
    io::{self, Write},
    mem,
    ops::RangeInclusive,
    rc::Rc,
    sync::Arc,
};

use canopen_node::{BitRate, Frame, NodeId, Settings, lss::Address};
use testkit::{
    flash::BoardFlash,
    frames,
    node_rig::{ADDRESS, NodeRig, device},
    random::Random,
    slave_bus::{BusAdapter, Habits, Happening, SlaveBus},
};

use crate::{
    assign::{file, new_file},
    emulated::{run, text},
};

const RATE: BitRate = BitRate::Kbit1000;
/// The node-ID of a slave without one.
const NONE: u8 = 0xFF;

/// The slaves, and the tool's adapter.
struct Slaves {
    adapter: BusAdapter,
}

/// The outcome of a command.
struct Outcome {
    text: String,
    code: u8,
    error: String,
    /// The virtual time that it took, in microseconds.
    us: u64,
    /// That until it printed the last node that is as in the table.
    us_to_last_known: u64,
}

/// What a command prints, and when.
struct Printed {
    adapter: BusAdapter,
    out: Box<dyn Write>,
    text: Vec<u8>,
    last_known: Rc<Cell<u64>>,
}

impl Write for Printed {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.text.extend(bytes);
        if self.text.ends_with(b"as in the table\n") {
            self.last_known.set(self.adapter.bus().now());
        }
        self.out.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}

impl Slaves {
    fn new(slaves: Vec<(NodeRig, Habits)>, random: &mut Random) -> Self {
        let random = Random::from_seed(random.u64());
        Self { adapter: BusAdapter::new(SlaveBus::new(slaves, random)) }
    }

    /// Runs `lss` by an adapter without a latency of its own.
    fn lss(&self, arguments: &str) -> Outcome {
        let arguments = format!("{arguments} --latency 0");
        let begin = self.adapter.bus().now();
        let last_known = Rc::new(Cell::new(begin));
        let adapter = Box::new(self.adapter.clone());
        let outcome = run(adapter, &Arc::default(), &arguments, |session| {
            let out = mem::replace(&mut session.out, Box::new(io::sink()));
            let (adapter, last_known) = (self.adapter.clone(), Rc::clone(&last_known));
            session.out = Box::new(Printed { adapter, out, text: Vec::new(), last_known });
        });
        let us = self.adapter.bus().now() - begin;
        println!("{} ms", us / 1_000);
        let us_to_last_known = last_known.get() - begin;
        Outcome {
            text: outcome.text,
            code: outcome.code,
            error: outcome.error,
            us,
            us_to_last_known,
        }
    }

    fn pass_ms(&self, ms: u64) {
        self.adapter.bus().pass_us(ms * 1_000);
    }

    /// Lets something happen to a slave so many microseconds from now on.
    fn plan(&self, after: u64, slave: usize, happening: Happening) {
        let mut bus = self.adapter.bus();
        let at = bus.now() + after;
        bus.plan(at, slave, happening);
    }

    /// Cuts and restores the power of all slaves.
    fn restart(&self) {
        for slave in 0..self.addresses().len() {
            self.plan(0, slave, Happening::PowerOff);
            self.plan(0, slave, Happening::PowerOn);
        }
        self.pass_ms(2_000);
    }

    fn addresses(&self) -> Vec<Address> {
        self.adapter.bus().slaves.iter().map(|slave| slave.rig.node.lss().address()).collect()
    }

    /// The active node-ID of each slave, all of which have power.
    fn active(&self) -> Vec<Option<NodeId>> {
        self.adapter.bus().slaves.iter().map(|slave| slave.rig.node.node_id()).collect()
    }

    /// Asserts that each slave has a node-ID, and that no two of them use or have stored the same.
    #[track_caller]
    fn assert_apart(&self) {
        let active = self.active();
        let stored = |rig: &NodeRig| rig.stored().and_then(|stored| stored.node_id);
        let stored: Vec<_> =
            self.adapter.bus().slaves.iter().map(|slave| stored(&slave.rig)).collect();
        let missing = active.iter().filter(|id| id.is_none()).count();
        assert_eq!((missing, twice(&active), twice(&stored)), (0, [].into(), [].into()));
    }
}

/// The node-IDs that several slaves have.
fn twice(ids: &[Option<NodeId>]) -> BTreeSet<NodeId> {
    let mut seen = BTreeSet::new();
    ids.iter().flatten().copied().filter(|id| !seen.insert(*id)).collect()
}

/// A slave with supervision of the bit rate.
fn slave(address: Address, node_id: u8) -> NodeRig {
    let settings =
        Settings::new(RATE.into()).with_node_id(NodeId::from_lss(node_id).expect("1..=127 or FF"));
    let device = device(address).with_rescue(true).with_defaults(settings).with_heartbeat_ms(1000);
    NodeRig::with_device(device, BoardFlash::blank(0), 0)
}

/// Slaves of ours with these node-IDs.
fn ours(random: &mut Random, node_ids: impl IntoIterator<Item = u8>) -> Vec<(NodeRig, Habits)> {
    let mut address = || Address { serial_number: random.u32() | 1, ..ADDRESS };
    node_ids.into_iter().map(|id| (slave(address(), id), Habits::default())).collect()
}

/// A node in a table.
fn node(id: u8, address: Address) -> String {
    format!("[[node]]\nid = {id}\naddress = \"{}\"\n", text(address))
}

#[test]
fn the_127_blank_boards_of_a_network_have_node_ids_within_5_s() {
    let mut random = Random::from_environment();
    let slaves = Slaves::new(ours(&mut random, [NONE; 127]), &mut random);
    let outcome = slaves.lss("assign --bit-rate 1000");
    assert_eq!(outcome.code, 0, "{}", outcome.error);
    assert_eq!(outcome.text.matches("stored, verified by a reset").count(), 127);
    slaves.assert_apart();
    // 4.90 s to 4.94 s.
    assert!(outcome.us <= 5_000_000, "{} us", outcome.us);
}

#[test]
fn the_127_known_boards_of_a_network_are_verified_within_300_ms() {
    const IDS: RangeInclusive<u8> = 1..=127;
    let mut random = Random::from_environment();
    let slaves = Slaves::new(ours(&mut random, IDS), &mut random);
    slaves.pass_ms(random.within(0..2_000));
    let nodes = IDS.zip(slaves.addresses()).map(|(id, address)| node(id, address));
    let table = file("127-known.toml", nodes.collect::<String>());
    let outcome = slaves.lss(&format!("assign --bit-rate 1000 --table {}", table.display()));
    assert_eq!(outcome.code, 0, "{}", outcome.error);
    assert_eq!(outcome.text.matches("as in the table").count(), 127);
    // 220 ms; the questions for others take 1.6 s more.
    assert!(outcome.us_to_last_known <= 300_000, "{} us", outcome.us_to_last_known);
}

#[test]
fn the_lss_addresses_of_two_products_with_one_node_id_are_not_mixed() {
    let address = |product_code, serial_number| Address { product_code, serial_number, ..ADDRESS };
    // Answers at the same moment would be one frame.
    let takes = |us: u64| Habits { other_us: us..us + 1, ..Habits::default() };
    let boards = vec![(slave(address(7, 1), 5), takes(100)), (slave(address(8, 2), 5), takes(250))];
    let outcome = Slaves::new(boards, &mut Random::from_seed(1)).lss("assign --bit-rate 1000");
    let words = "2 boards have node-ID 5, with the serial numbers 00000001, 00000002: give all but";
    assert!(outcome.error.starts_with(words), "{}", outcome.error);
}

/// The slaves of ours in the mixed network.
const OURS: u8 = 20;

/// Some slaves of ours, one without identify remote slave that holds one frame, and a slow one.
fn mixed(random: &mut Random) -> Vec<(NodeRig, Habits)> {
    let ids: Vec<u8> =
        (1..=OURS).map(|number| if random.one_in(3) { number + 40 } else { NONE }).collect();
    let mut slaves = ours(random, ids);
    let one_frame = Address { vendor_id: 0x7777, serial_number: random.u32() | 1, ..ADDRESS };
    let without = &[0x46, 0x47, 0x48, 0x49, 0x4A, 0x4B, 0x4C];
    slaves.push((slave(one_frame, NONE), Habits { poll_us: 1_000, without, ..Habits::default() }));
    let slow = Address { product_code: 7, serial_number: random.u32() | 1, ..ADDRESS };
    slaves.push((slave(slow, NONE), Habits { answer_us: 2_000..20_000, ..Habits::default() }));
    slaves
}

/// What another master sends. It gives node-IDs that the tool gives, too.
fn interference(random: &mut Random, addresses: &[Address], number: u64) -> Vec<Frame> {
    let parts: [u32; 4] = random.pick(addresses).into();
    let select = |(specifier, part)| format!("{specifier:02X} {}", frames::number(part));
    let mut requests = vec!["04 00".to_owned()];
    match random.within(0..6) {
        0 => {}
        1 => requests = vec!["04 01".into()],
        2 => requests = vec!["51 00 00 00 00 80".into()],
        3 => requests = vec!["5E".into()],
        // It gives a node-ID to a slave, and stores it.
        _ => {
            requests.extend((0x40..).zip(parts).map(select));
            requests.extend([format!("11 {:02X}", 1 + number), "17".into(), "04 00".into()]);
        }
    }
    requests.iter().map(|request| frames::request(request)).collect()
}

/// Runs the tool until it is content, and does what it says if boards share a node-ID, or if one has that of another.
fn finish(slaves: &Slaves, assign: &str) {
    for _ in 0..8 {
        let outcome = slaves.lss(assign);
        let active = slaves.active();
        if outcome.code == 0 {
            assert_eq!(twice(&active), [].into(), "the tool is content");
            return;
        }
        let is_named = |id: &NodeId| {
            let id = id.get();
            ["boards have", "another board has"]
                .iter()
                .any(|who| outcome.error.contains(&format!("{who} node-ID {id}, w")))
        };
        let Some(id) = (1..=127).filter_map(NodeId::new).find(is_named) else { continue };
        let one = active.iter().rposition(|active| *active == Some(id)).expect("it has it");
        let free = (1..=127).rev().find(|free| !active.contains(&NodeId::new(*free)));
        let address = text(slaves.addresses()[one]);
        let free = free.expect("fewer than 127 slaves");
        slaves.lss(&format!("set-id {free} --store --reset --bit-rate 1000 --address {address}"));
    }
    panic!("the tool does not finish");
}

#[test]
fn no_node_id_is_missing_or_twice_after_faults_and_another_master() {
    /// One in so many frames is lost by each slave, and by the tool.
    const LOST: u64 = 100;
    let mut random = Random::from_environment();
    for run in 0..10 {
        println!("run {run}");
        let slaves = Slaves::new(mixed(&mut random), &mut random);
        let addresses = slaves.addresses();
        let table = new_file("mixed.toml");
        let known = slaves.active().into_iter().zip(&addresses);
        let known = known.filter_map(|(id, address)| Some(node(id?.get(), *address)));
        fs::write(&table, known.collect::<String>()).expect("a table");
        slaves.adapter.bus().faults.lost = LOST;
        slaves.pass_ms(random.within(0..1_500));
        let now = slaves.adapter.bus().now();
        for _ in 0..random.within(1..6) {
            let slave = random.within(0..addresses.len() as u64) as usize;
            let off = random.within(0..3_000_000);
            slaves.plan(off, slave, Happening::PowerOff);
            slaves.plan(off + random.within(10_000..1_500_000), slave, Happening::PowerOn);
        }
        for number in 0..random.within(0..5) {
            let mut at = now + random.within(0..3_000_000);
            for frame in interference(&mut random, &addresses, number) {
                slaves.adapter.bus().send_from_another_master(at, frame);
                at += random.within(200..2_000);
            }
        }
        let assign = format!("assign --bit-rate 1000 --table {}", table.display());
        slaves.lss(&assign);
        slaves.lss(&assign);
        // Frames are lost until the end.
        slaves.pass_ms(5_000);
        slaves.adapter.bus().calm();
        slaves.pass_ms(1_500);
        finish(&slaves, &assign);
        // Another master may have stored a node-ID that takes effect now.
        slaves.restart();
        finish(&slaves, &assign);
        slaves.restart();
        slaves.assert_apart();
    }
}

#[test]
fn no_board_is_lost_if_one_is_pulled_out_at_a_change_of_the_rate() {
    const BOARDS: u8 = 32;
    let mut random = Random::from_environment();
    for run in 0..20 {
        let slaves = Slaves::new(ours(&mut random, 1..=BOARDS), &mut random);
        slaves.pass_ms(random.within(0..1_500));
        let gone = random.within(0..BOARDS.into()) as usize;
        let happening = random.pick(&[Happening::PullOut, Happening::PowerOff]);
        let after = random.within(0..4_500_000);
        println!("run {run}, board {gone}: {happening:?} after {} ms", after / 1_000);
        slaves.plan(after, gone, happening);
        let outcome = slaves.lss("set-rate 500 --bit-rate 1000 --delay 100");
        // The others are at one bit rate.
        let rate = if outcome.code == 0 { BitRate::Kbit500 } else { RATE };
        for (number, slave) in slaves.adapter.bus().slaves.iter().enumerate() {
            assert!(number == gone || slave.rig.bit_rate() == rate, "board {number}");
        }
        // All have stored it, also the one that was pulled out, unless it was not there for the plan.
        slaves.adapter.bus().calm();
        slaves.restart();
        let list = slaves.lss(&format!("list --bit-rate {}", rate.kbit_per_s()));
        let is_planned = !outcome.text.starts_with(&format!("plan: {} boards", BOARDS - 1));
        let missing = usize::from(BOARDS) + 1 - list.text.lines().count();
        let is_absent = (missing, outcome.code, is_planned) == (1, 0, false);
        // It was pulled out between its store and the answer, and is named.
        let board = text(slaves.addresses()[gone]);
        let has_stored = format!("board {board}: no answer to store configuration");
        let is_told = missing == 1 && outcome.error.starts_with(&has_stored);
        assert!(missing == 0 || is_absent || is_told, "{}", outcome.error);
    }
}
