//! `cargo verify no-harm`: random situations on the bus, each run with and without bit-rate supervision.

mod draw;
mod judge;
mod life;
mod situation;

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use anyhow::ensure;
use emulator::{Time, chip::Part};

use testkit::{parallel, random::Random};

use judge::{Images, Verdict};

/// The interval between lines of progress.
const PROGRESS: Duration = Duration::from_secs(5);

/// Check in random situations that supervision of the bit rate never does harm
///
/// A situation is drawn from its seed: one to eight boards, some with a wrong rate stored; a master that listens,
/// polls, tries one rate after another or is absent; LSS sessions with bit errors; switches of the bit rate that some
/// boards miss and that the master follows late; foreign devices and masters at other rates; shorts, broken wires, bad
/// contacts, noise, bit errors and power cuts. It runs twice: with the product's image, and with the plain slave, which
/// is the same firmware with `with_rescue(false)`. Then the master looks for all boards at one rate, polling each every
/// 20 ms (object 1000h by SDO, 4C without a node-ID) or only listening for heartbeats.
///
/// A board that has proven its rate, or within 30 s of a switch, must be reached at most 200 ms later than the plain
/// slave (25 frame times at slow rates); by a master that only listens 0.76 s later within 30 s of a switch. One that has
/// not proven its rate may take longer: 5 s after noise, a fault, a foreign device or beside a lost board; 100 ms more
/// after a disturbance if it is alone with a master that asks; 0.76 s without an acknowledge if there are several boards
/// or the master only hears it. Nothing is demanded of it while others are proven at another rate, or if a disturbance
/// had led it away when the others switched.
///
/// A plain slave at a different rate from the master's is lost; the product must be found within 5 s of the first
/// evidence, 30 s later after a commanded switch, unless it or another board has proven a wrong rate. After a session the
/// stored settings and the bit rate must be those of the plain slave.
///
/// Chance decides when a board is reached beside boards at another rate, after bus-off, and if the requests of a switch
/// were disturbed. Such a situation is repeated with 32 other deviations of the crystals: the board must be in time about
/// as often as the plain slave.
///
/// A failing situation is printed with the seed that replays it.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// Number of situations: 1 to 1,000,000
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    situations: u64,
    /// Seed of the campaign; random if not given
    #[arg(long)]
    seed: Option<u64>,
    /// Run only the situation with this seed, and print its events
    #[arg(long, value_name = "SEED", conflicts_with_all = ["situations", "seed"])]
    replay: Option<u64>,
    /// The chip on the boards
    #[arg(long, default_value = testkit::image::PART.name())]
    chip: Part,
}

/// Runs the campaign. Fails if a board is worse off than with the plain slave, or is not found.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let part = arguments.chip;
    let images = Images {
        part,
        plain: testkit::image::build_plain(part)?,
        product: testkit::image::build(part)?,
    };
    match arguments.replay {
        Some(seed) => replay(&images, seed),
        None => campaign(&images, arguments),
    }
}

fn replay(images: &Images, seed: u64) -> anyhow::Result<()> {
    let situation = draw::situation(seed);
    println!("{}\n{situation}", situation.kind);
    let verdict = images.judge(&situation);
    for line in &verdict.log {
        println!("  {line}");
    }
    println!("{} rescued, worst delay {} ms", verdict.rescued, verdict.worst_delay.as_ms());
    for failure in &verdict.failures {
        println!("{failure}");
    }
    ensure!(verdict.failures.is_empty(), "the situation fails");
    Ok(())
}

/// The results of a kind of situation so far.
#[derive(Default)]
struct Tally {
    situations: u64,
    worse: u64,
    not_found: u64,
    rescued: usize,
    worst_delay: Time,
}

impl Tally {
    fn add(&mut self, verdict: &Verdict) {
        let not_found = verdict.failures.iter().filter(|failure| failure.is_not_found()).count();
        self.situations += 1;
        self.worse += u64::from(verdict.failures.len() > not_found);
        self.not_found += not_found as u64;
        self.rescued += verdict.rescued;
        self.worst_delay = self.worst_delay.max(verdict.worst_delay);
    }

    fn text(&self) -> String {
        let Self { situations, worse, not_found, rescued, worst_delay } = self;
        let delay = worst_delay.as_ms();
        format!(
            "{situations} situations, {worse} worse than the plain slave, {rescued} rescued, \
             {not_found} not found, worst delay {delay} ms"
        )
    }
}

fn campaign(images: &Images, arguments: &Arguments) -> anyhow::Result<()> {
    let seed = arguments.seed.unwrap_or_else(Random::seed);
    let mut seeds = Random::from_seed(seed);
    let seeds: Vec<u64> = (0..arguments.situations).map(|_| seeds.u64() >> 32).collect();
    println!("--seed {seed}");
    let begin = Instant::now();
    let mut all = Tally::default();
    let mut kinds: BTreeMap<&str, Tally> = BTreeMap::new();
    let mut reported = begin;
    let judge = |seed: &u64| images.judge(&draw::situation(*seed));
    parallel::map(&seeds, judge, |index, verdict| {
        let kind = draw::situation(seeds[index]).kind;
        all.add(&verdict);
        kinds.entry(kind).or_default().add(&verdict);
        if let Some(failure) = verdict.failures.first() {
            println!("--replay {}: {kind}: {failure}", seeds[index]);
        }
        if reported.elapsed() >= PROGRESS {
            reported = Instant::now();
            println!("{}, {} s", all.text(), begin.elapsed().as_secs());
        }
    });
    println!();
    for (kind, tally) in kinds {
        println!("{kind:18} {}", tally.text());
    }
    println!("\n{}, {} s, seed {seed}", all.text(), begin.elapsed().as_secs());
    ensure!(all.worse + all.not_found == 0, "supervision does harm, or does not help");
    Ok(())
}
