//! `cargo verify commission`: the figures of `lss` on slaves within the process, in virtual time.

mod mixed;
mod network;
mod rate;

use std::{env, fs, path::PathBuf, process::ExitCode, time::Instant};

use canopen_node::{BitRate, lss::Address};
use clap::Parser;
use testkit::random::Random;

use network::{NONE, Network, ours};

/// The figures of `lss` on slaves within the process, in virtual time at 1 Mbit/s
#[derive(Parser)]
#[command(name = "cargo verify commission")]
struct Arguments {
    /// A tenth of the random runs
    #[arg(long)]
    quick: bool,
    /// Seed of the campaign; random if not given
    #[arg(long)]
    seed: Option<u64>,
    /// Run only the mixed network with this seed
    #[arg(long, value_name = "SEED")]
    mixed: Option<u64>,
    /// Run only the rate change with this seed
    #[arg(long, value_name = "SEED")]
    rate: Option<u64>,
}

/// A goal that was missed, in words.
type Judgement = Result<(), String>;

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let seed = arguments.seed.unwrap_or_else(Random::seed);
    let mut random = Random::from_seed(seed);
    let judgements = match (arguments.mixed, arguments.rate) {
        (Some(seed), _) => vec![mixed::run(seed, true).map(drop)],
        (None, Some(seed)) => vec![rate::run(seed, true).map(drop)],
        (None, None) => {
            println!("--seed {seed}");
            let tenth = if arguments.quick { 10 } else { 1 };
            vec![
                blank(&mut random),
                known(&mut random),
                mixed::campaign(&mut random, 100 / tenth),
                rate::campaign(&mut random, 200 / tenth),
            ]
        }
    };
    let failures: Vec<String> = judgements.into_iter().filter_map(Result::err).collect();
    failures.iter().for_each(|failure| println!("FAILED: {failure}"));
    match failures.is_empty() {
        true => ExitCode::SUCCESS,
        false => ExitCode::FAILURE,
    }
}

/// Seconds of microseconds.
fn seconds(us: u64) -> f64 {
    us as f64 / 1e6
}

/// A file of this program alone, which does not exist.
fn new_file(name: &str) -> PathBuf {
    let path = env::temp_dir().join(format!("lss-figures-{}-{name}", std::process::id()));
    let _ = fs::remove_file(&path);
    path
}

/// 127 blank slaves get their node-IDs.
fn blank(random: &mut Random) -> Judgement {
    let begin = Instant::now();
    let network = Network::new(ours(random, BitRate::Kbit1000, &[NONE; 127]), random);
    let outcome = network.lss("assign --bit-rate 1000");
    let (us, requests) = (outcome.us, network.adapter.bus().requests);
    println!(
        "127 blank slaves, `lss assign`: {:.2} s, {requests} frames of the tool ({:.1} s of this computer)",
        seconds(us),
        begin.elapsed().as_secs_f64()
    );
    let stored = outcome.text.matches("stored, verified by a reset").count();
    match (outcome.code, stored, network.shared().is_empty(), us) {
        (0, 127, true, ..=5_000_000) => Ok(()),
        _ => Err(format!("127 blank slaves: {outcome:?}")),
    }
}

/// 127 known slaves are verified.
fn known(random: &mut Random) -> Judgement {
    let ids: Vec<u8> = (1..=127).collect();
    let network = Network::new(ours(random, BitRate::Kbit1000, &ids), random);
    network.pass_ms(random.within(0..2_000));
    let table = new_file("known.toml");
    let nodes = ids.iter().zip(network.addresses()).map(|(id, address)| node(*id, address));
    let written = fs::write(&table, nodes.collect::<String>());
    let outcome = network.lss(&format!("assign --bit-rate 1000 --table {}", table.display()));
    let _ = fs::remove_file(&table);
    println!(
        "127 known slaves, `lss assign --table`: verified in {:.2} s; with the question for others {:.2} s",
        seconds(outcome.us_to_last_known),
        seconds(outcome.us)
    );
    let verified = outcome.text.matches("as in the table").count();
    match (written.is_ok(), outcome.code, verified, outcome.us_to_last_known) {
        (true, 0, 127, ..=300_000) => Ok(()),
        _ => Err(format!("127 known slaves: {outcome:?}")),
    }
}

/// A node in a table.
fn node(id: u8, address: Address) -> String {
    format!("[[node]]\nid = {id}\naddress = \"{}\"\n", text(address))
}

/// An LSS address as the tool writes it.
fn text(address: Address) -> String {
    let parts: [u32; 4] = address.into();
    parts.map(|part| format!("{part:08X}")).join(":")
}
