//! `cargo verify power-cut`: cuts the power during writes of the settings in the library.

mod histories;

use std::{collections::BTreeMap, time::Instant};

use testkit::random::Random;

/// Erase cycles guaranteed by the data sheet for a sector (STM32F405, table "flash memory endurance").
const ENDURANCE: u64 = 10_000;
const SECTORS: u64 = 2;
const HOURS_A_YEAR: u64 = 8_766;

/// Cut the power at every step of writing the settings, and check that none are lost
///
/// Every history of four power-ons (--long: six) with up to three stores each. The power fails in any
/// one or two of the program and erase steps; an interrupted program step leaves any of its bits, an interrupted erase
/// anything. The same for stores of parameters, in turn with stores of settings, in three power-ons (--long: four).
/// Both also for flash that is programmed in units of 1, 2, 8, 16 and 32 bytes, with a power-on less. A torn unit reads
/// differently each time, or as an error. With each unit also in sectors of 2 KB and 16 KB: the power fails in each step
/// while the log moves, and again soon after.
///
/// The release image is cut by `cargo test --test image power_cut`.
///
/// Fails if settings are lost.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// Two more power-ons in a history, one more with parameters; takes some minutes
    #[arg(long)]
    long: bool,
    /// A power-on less in a history; takes less than a minute
    #[arg(long, conflicts_with = "long")]
    quick: bool,
    /// Seed for the content left by interrupted steps; random if not given
    #[arg(long)]
    seed: Option<u64>,
}

impl Arguments {
    /// The power-ons in a history of settings, and in one of parameters.
    const fn lives(&self) -> (usize, usize) {
        match (self.quick, self.long) {
            (true, _) => (3, 2),
            (_, true) => (6, 4),
            _ => (4, 3),
        }
    }
}

/// Prints the number of cuts. Fails or panics if settings are lost.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let begin = Instant::now();
    let seed = arguments.seed.unwrap_or_else(Random::seed);
    println!("--seed {seed}");
    let mut random = Random::from_seed(seed);

    println!("\nThe settings log, cut in each step and in each pair of steps");
    let mut of_units = BTreeMap::new();
    for histories in histories::all(arguments.lives()) {
        let cuts = (histories.run)(&mut random);
        print(&histories.description, cuts);
        *of_units.entry(histories.unit).or_default() += cuts;
    }
    for (unit, cuts) in of_units {
        print(&format!("program unit {unit}, all of these"), cuts);
    }

    let stores = histories::stores_an_erase();
    let years = stores * SECTORS * ENDURANCE / HOURS_A_YEAR;
    println!(
        "\nStores per erase, with a power-on after each: {stores}; at one store an hour: {years} years"
    );
    println!("\n{:.0} s", begin.elapsed().as_secs_f64());
    Ok(())
}

fn print(what: &str, cuts: u64) {
    println!("  {what:80} {cuts:>8} cuts, no loss");
}
