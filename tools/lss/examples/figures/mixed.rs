//! A mixed network that is commissioned while frames are lost, power is cut and another master interferes.

use std::{fs, time::Instant};

use canopen_node::{BitRate, Frame, NodeId, lss::Address};
use testkit::{
    frames,
    node_rig::NodeRig,
    random::Random,
    slave_bus::{Habits, Happening},
};

use crate::{
    Judgement,
    network::{ADDRESS, NONE, Network, Outcome, ours, slave},
    new_file, node, text,
};

const OURS: usize = 20;
const RATE: BitRate = BitRate::Kbit1000;
/// One in so many frames is lost by each slave, and by the tool.
const LOST: u64 = 300;
/// The first node-ID that the other master gives.
const OTHER_IDS: u64 = 100;
/// How often the tool is run at most until it is content.
const RUNS: usize = 8;

/// The counts of a run.
#[derive(Default)]
pub struct Count {
    runs: usize,
    /// Those that another master ended.
    ended_by_master: usize,
    /// Those boards that got another node-ID because the tool said so.
    mended: usize,
}

pub fn campaign(random: &mut Random, starts: usize) -> Judgement {
    let begin = Instant::now();
    let mut all = Count::default();
    let mut failures = Vec::new();
    for _ in 0..starts {
        let seed = random.u64() >> 32;
        match run(seed, false) {
            Ok(count) => {
                all.runs += count.runs;
                all.ended_by_master += count.ended_by_master;
                all.mended += count.mended;
            }
            Err(failure) => failures.push(format!("--mixed {seed}: {failure}")),
        }
    }
    println!(
        "mixed network of {OURS} slaves of ours and 2 foreign ones: {} of {starts} starts with a node-ID twice or \
         missing; {} runs of the tool, {} ended by another master; {} times it named boards of one node-ID, which the \
         other master had given, and they were parted as it says ({:.1} s of this computer)",
        failures.len(),
        all.runs,
        all.ended_by_master,
        all.mended,
        begin.elapsed().as_secs_f64()
    );
    match failures.is_empty() {
        true => Ok(()),
        false => Err(failures.join("\n")),
    }
}

/// Some slaves of ours, one without identify remote slave that holds one frame, and a slow one.
fn slaves(random: &mut Random) -> Vec<(NodeRig, Habits)> {
    let ids: Vec<u8> =
        (1..=OURS as u8).map(|number| if random.one_in(3) { number + 40 } else { NONE }).collect();
    let mut slaves = ours(random, RATE, &ids);
    let one_frame = Address { vendor_id: 0x7777, serial_number: random.u32() | 1, ..ADDRESS };
    let without = &[0x46, 0x47, 0x48, 0x49, 0x4A, 0x4B, 0x4C];
    slaves.push((
        slave(one_frame, NONE, RATE),
        Habits { poll_us: 1_000, without, ..Habits::default() },
    ));
    let slow = Address { product_code: 7, serial_number: random.u32() | 1, ..ADDRESS };
    let answer_us = 2_000..20_000;
    slaves.push((slave(slow, NONE, RATE), Habits { answer_us, ..Habits::default() }));
    slaves
}

/// What another master sends.
fn interference(random: &mut Random, network: &Network, number: u64) -> Vec<Frame> {
    let addresses = network.addresses();
    let address = random.pick(&addresses);
    let parts: [u32; 4] = address.into();
    let select =
        |specifier: usize| format!("{:02X} {}", 0x40 + specifier, frames::number(parts[specifier]));
    let requests = match random.within(0..6) {
        0 => vec!["04 00".into()],
        1 => vec!["04 01".into()],
        2 => vec!["51 00 00 00 00 80".into()],
        3 => vec!["5E".into()],
        // It gives a node-ID to a slave, and stores it.
        _ => vec![
            "04 00".into(),
            select(0),
            select(1),
            select(2),
            select(3),
            format!("11 {:02X}", OTHER_IDS + number),
            "17".into(),
            "04 00".into(),
        ],
    };
    requests.iter().map(|request| frames::request(request)).collect()
}

/// One start; fails if the tool does not finish, or if two slaves have one node-ID then.
pub fn run(seed: u64, prints: bool) -> Result<Count, String> {
    let mut random = Random::from_seed(seed);
    let network = Network::new(slaves(&mut random), &mut random);
    let table = new_file(&format!("mixed-{seed}.toml"));
    let mut known = String::new();
    for slave in &network.adapter.bus().slaves {
        let lss = slave.rig.node.lss();
        known.extend(slave.rig.node.node_id().map(|id| node(id.get(), lss.address())));
    }
    fs::write(&table, known).map_err(|error| error.to_string())?;
    network.adapter.bus().lost = LOST;
    network.pass_ms(random.within(0..1_500));
    let now = network.adapter.bus().now();
    for _ in 0..random.within(1..6) {
        let board = random.within(0..OURS as u64 + 2) as usize;
        let at = now + random.within(0..3_000_000);
        let back = at + random.within(10_000..1_500_000);
        let mut bus = network.adapter.bus();
        bus.plan(at, board, Happening::PowerOff);
        bus.plan(back, board, Happening::PowerOn);
    }
    for number in 0..random.within(0..5) {
        let mut at = now + random.within(0..3_000_000);
        for frame in interference(&mut random, &network, number) {
            network.adapter.bus().send_from_another_master(at, frame);
            at += random.within(200..2_000);
        }
    }
    let mut count = Count::default();
    let assign = format!("assign --bit-rate 1000 --table {}", table.display());
    for _ in 0..2 {
        let outcome = network.lss(&assign);
        count.note(&outcome, prints);
    }
    // Frames are lost until the end.
    network.pass_ms(5_000);
    network.adapter.bus().calm();
    network.pass_ms(1_500);
    let mut result = finish(&network, &assign, &mut count, prints);
    if result.is_ok() {
        // Another master may have stored a node-ID that takes effect now.
        restart(&network);
        result = finish(&network, &assign, &mut count, prints);
    }
    let _ = fs::remove_file(&table);
    result?;
    restart(&network);
    judge(&network)?;
    Ok(count)
}

impl Count {
    fn note(&mut self, outcome: &Outcome, prints: bool) {
        if prints {
            println!("{} ms:\n{}{}", outcome.us / 1_000, outcome.text, outcome.error);
        }
        self.runs += 1;
        self.ended_by_master += usize::from(outcome.error.starts_with("two masters"));
    }
}

/// Runs the tool until it is content, and does what it says if boards share a node-ID.
fn finish(network: &Network, assign: &str, count: &mut Count, prints: bool) -> Result<(), String> {
    let mut error = String::new();
    for _ in 0..RUNS {
        let outcome = network.lss(assign);
        count.note(&outcome, prints);
        let shared = network.active_shared();
        if outcome.code == 0 {
            let why = format!("the tool is content with node-IDs twice: {shared:?}");
            return if shared.is_empty() { Ok(()) } else { Err(why) };
        }
        if let Some(id) = shared.first() {
            if !outcome.error.contains(&format!("boards have node-ID {id}")) {
                continue;
            }
            let addresses = network.addresses();
            let bus_ids = network.active();
            let one = bus_ids.iter().rposition(|active| active.map(NodeId::get) == Some(*id));
            let address = text(addresses[one.unwrap_or(0)]);
            let free = (1..=127_u8)
                .rev()
                .find(|free| bus_ids.iter().flatten().all(|taken| taken.get() != *free));
            let free = free.unwrap_or(127);
            let set = format!("set-id {free} --store --reset --bit-rate 1000 --address {address}");
            count.mended += 1;
            let outcome = network.lss(&set);
            count.note(&outcome, prints);
        }
        error = outcome.error;
    }
    Err(format!("the tool does not finish: {error}"))
}

/// Cuts and restores the power of all slaves.
fn restart(network: &Network) {
    for number in 0..OURS + 2 {
        network.adapter.bus().plan(0, number, Happening::PowerOff);
        network.adapter.bus().plan(0, number, Happening::PowerOn);
    }
    network.pass_ms(2_000);
}

/// Each slave has a node-ID of its own, and has stored it.
fn judge(network: &Network) -> Judgement {
    let shared = network.shared();
    let missing = network.active().iter().filter(|id| id.is_none()).count();
    match (shared.is_empty(), missing) {
        (true, 0) => Ok(()),
        _ => Err(format!("node-IDs twice: {shared:?}; {missing} slaves without one")),
    }
}
