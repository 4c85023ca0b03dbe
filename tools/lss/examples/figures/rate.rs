//! A rate change of 32 boards, of which one is pulled out at any moment.

use std::{collections::BTreeMap, time::Instant};

use canopen_node::BitRate;
use testkit::{random::Random, slave_bus::Happening};

use crate::{
    Judgement,
    network::{Network, ours},
};

const BOARDS: usize = 32;
const FROM: BitRate = BitRate::Kbit1000;
const TO: BitRate = BitRate::Kbit500;

pub fn campaign(random: &mut Random, runs: usize) -> Judgement {
    let begin = Instant::now();
    let mut failures = Vec::new();
    let mut ends: BTreeMap<&str, usize> = BTreeMap::new();
    for _ in 0..runs {
        let seed = random.u64() >> 32;
        match run(seed, false) {
            Ok(end) => *ends.entry(end).or_default() += 1,
            Err(failure) => failures.push(format!("--rate {seed}: {failure}")),
        }
    }
    println!(
        "rate change of {BOARDS} boards with one pulled out: boards lost in {} of {runs} runs; {ends:?} ({:.1} s of this \
         computer)",
        failures.len(),
        begin.elapsed().as_secs_f64()
    );
    match failures.is_empty() {
        true => Ok(()),
        false => Err(failures.join("\n")),
    }
}

/// One change; fails if a board is lost.
pub fn run(seed: u64, prints: bool) -> Result<&'static str, String> {
    let mut random = Random::from_seed(seed);
    let ids: Vec<u8> = (1..=BOARDS as u8).collect();
    let network = Network::new(ours(&mut random, FROM, &ids), &mut random);
    network.pass_ms(random.within(0..1_500));
    let board = random.within(0..BOARDS as u64) as usize;
    let now = network.adapter.bus().now();
    let happening = match random.one_in(2) {
        true => Happening::PullOut,
        false => Happening::PowerOff,
    };
    let at = now + random.within(0..4_500_000);
    network.adapter.bus().plan(at, board, happening);
    let outcome = network.lss("set-rate 500 --bit-rate 1000 --delay 100");
    if prints {
        let ms = (at - now) / 1_000;
        println!("board {board}: {happening:?} at {ms} ms of {}", outcome.us / 1_000);
        println!("{}{}", outcome.text, outcome.error);
    }
    // The others are at one bit rate, and have stored it.
    let rate = if outcome.code == 0 { TO } else { FROM };
    for (number, slave) in network.adapter.bus().slaves.iter().enumerate() {
        if number != board && slave.rig.bit_rate() != rate {
            return Err(format!(
                "board {number} is at {}: {}",
                slave.rig.bit_rate(),
                outcome.error
            ));
        }
    }
    // All come back, also the one that was pulled out.
    network.adapter.bus().calm();
    for number in 0..BOARDS {
        network.adapter.bus().plan(0, number, Happening::PowerOff);
        network.adapter.bus().plan(0, number, Happening::PowerOn);
    }
    network.pass_ms(2_000);
    let list = network.lss(&format!("list --bit-rate {}", rate.kbit_per_s()));
    let listed = list.text.lines().skip(1).count();
    // The plan says how many boards it is for.
    let planned = format!("plan: {} boards", BOARDS - 1);
    match (listed, outcome.code) {
        (listed, 0) if listed + 1 == BOARDS && outcome.text.starts_with(&planned) => {
            Ok("pulled out before the plan")
        }
        (BOARDS, 0) => Ok("all at the new bit rate"),
        (BOARDS, _) if outcome.error.contains("nothing was switched") => Ok("nothing switched"),
        (BOARDS, _) => Ok("all at the old bit rate again"),
        _ => Err(format!("{listed} boards answer at {rate}: {}", outcome.error)),
    }
}
