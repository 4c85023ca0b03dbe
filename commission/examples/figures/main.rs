//! The figures of `lss` on slaves within the process, in virtual time: `cargo verify commission`.

mod network;

use canopen_node::BitRate;
use network::Network;
use testkit::random::Random;

fn main() {
    let seed = Random::seed();
    println!("--seed {seed}");
    let mut random = Random::from_seed(seed);
    blank(&mut random, 127, 0);
}

fn blank(random: &mut Random, count: usize, latency_us: u64) {
    let network = Network::new(random, BitRate::Kbit1000, &vec![0xFF; count], &[]);
    network.adapter.bus().latency_us = latency_us;
    let begin = std::time::Instant::now();
    let outcome = network.lss("assign --bit-rate 1000 --latency 0");
    println!("{} lines, code {} {}", outcome.text.lines().count(), outcome.code, outcome.error);
    println!(
        "{} us, {} requests, {:?}",
        outcome.us,
        network.adapter.bus().requests,
        begin.elapsed()
    );
}
