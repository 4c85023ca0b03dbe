//! `cargo verify soak`: a month in the life of a network, in virtual time.

use std::time::Instant;

use anyhow::Context;
use testkit::{
    random::Random,
    sessions::outcome,
    soak::{BOARDS, Soak, image},
};

const DAY_MICROS: f64 = 86_400e6;
/// The virtual days with `--quick`.
const QUICK_DAYS: f64 = 0.25;
/// The sessions of the release image, and those with `--quick`.
const SESSIONS: u64 = 20;
const QUICK_SESSIONS: u64 = 1;
/// The lines of progress.
const PARTS: u32 = 30;

/// Let a network live for a month of virtual time, and check its rules
///
/// Eight boards send heartbeats. After up to an hour of quiet something happens: power cuts, switches of the bit rate
/// that are interrupted or abandoned, stores in which the power fails, new boards, boards with the node-ID of another,
/// strangers at a wrong bit rate. Then a master finds all boards within a minute. In the quiet time every heartbeat
/// is in time, and there is no emergency. No node sends with a node-ID that it does not have, and no settings that were
/// confirmed are lost.
///
/// The nodes and their settings logs run in the process; the bus between them carries whole frames. Then eight emulated
/// boards with the release image live for some minutes, with power cuts and switches of the bit rate.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// Days of virtual time: 0.01 to 3650
    #[arg(long, default_value_t = 30.0, value_parser = days)]
    days: f64,
    /// Six hours, and one session of the emulated boards
    #[arg(long, conflicts_with = "days")]
    quick: bool,
    /// Seed of the events; random if not given
    #[arg(long)]
    seed: Option<u64>,
}

fn days(text: &str) -> Result<f64, &'static str> {
    let days = text.parse().ok().filter(|days| (0.01..=3650.0).contains(days));
    days.ok_or("0.01 to 3650")
}

/// Runs the life. Fails if a board breaks a rule.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let seed = arguments.seed.unwrap_or_else(Random::seed);
    println!("--seed {seed}");
    let end = DAY_MICROS * if arguments.quick { QUICK_DAYS } else { arguments.days };
    let begin = Instant::now();
    let days = |soak: &Soak| soak.now() as f64 / DAY_MICROS;
    let soak = outcome(|| {
        let mut soak = Soak::new(seed);
        for part in 1..=PARTS {
            while (soak.now() as f64) < end * f64::from(part) / f64::from(PARTS) {
                soak.live_on();
            }
            let (days, seconds) = (days(&soak), begin.elapsed().as_secs());
            println!("{days:>7.2} days, {} frames, {seconds} s", soak.counts().frames);
        }
        soak
    });
    let soak = soak.with_context(|| format!("a rule is broken, with --seed {seed}"))?;
    println!("\n{BOARDS} boards, {:.2} days: {:#?}", days(&soak), soak.counts());
    println!("{:.0} s", begin.elapsed().as_secs_f64());

    let sessions = if arguments.quick { QUICK_SESSIONS } else { SESSIONS };
    let mut random = Random::from_seed(seed);
    let begin = Instant::now();
    let mut virtual_ms = 0;
    for _ in 0..sessions {
        let before = random.clone();
        let time = outcome(|| image::session(&mut random)).with_context(|| {
            format!("the release image breaks a rule, with --seed {seed}, in session {before:?}")
        })?;
        virtual_ms += time.as_ms();
    }
    let seconds = begin.elapsed().as_secs_f64();
    println!("{BOARDS} emulated boards, {} s of virtual time: {seconds:.0} s", virtual_ms / 1000);
    Ok(())
}

#[cfg(test)]
mod tests {
    #[test]
    fn a_life_has_a_beginning_and_an_end() {
        for (text, days) in [("0.01", 0.01), ("30", 30.0), ("3650", 3650.0)] {
            assert_eq!(super::days(text), Ok(days));
        }
        for text in ["0", "-1", "99999999999", "inf", "NaN", "x"] {
            assert!(super::days(text).is_err(), "{text}");
        }
    }
}
