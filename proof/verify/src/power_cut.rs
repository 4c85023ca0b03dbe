//! `cargo verify power-cut`: cuts the power during writes of the settings, in the library and in the release image.

mod histories;

use std::{collections::BTreeMap, time::Instant};

use anyhow::Context;
use emulator::{board, chip::Part};
use testkit::{boards::Variant, power_cut::image::Session, random::Random};

/// Erase cycles guaranteed by the data sheet for a sector (STM32F405, table "flash memory endurance").
const ENDURANCE: u64 = 10_000;
const SECTORS: u64 = 2;
const HOURS_A_YEAR: u64 = 8_766;
/// Cuts at random instants in each session on the board.
const INSTANTS: usize = 250;
const INSTANTS_LONG: usize = 2_000;
/// Cuts of each kind in each session on the board, with `--quick`.
const QUICK: usize = 12;

/// Cut the power at every step of writing the settings, and check that none are lost
///
/// In the library: every history of four power-ons (--long: six) with up to three stores each. The power fails in any
/// one or two of the program and erase steps; an interrupted program step leaves any of its bits, an interrupted erase
/// anything. The same for stores of parameters, in turn with stores of settings, in three power-ons (--long: four).
/// Both also for flash that is programmed in units of 1, 2, 8, 16 and 32 bytes, with a power-on less. A torn unit reads
/// differently each time, or as an error. With each unit also in sectors of 2 KB and 16 KB: the power fails in each step
/// while the log moves, and again soon after.
///
/// In the release image on an emulated board: two commissionings by LSS, from a blank flash, from one with a half that
/// is nearly full, and from one with a half that has to be erased; with the example `io`, two stores of parameters by
/// 1010h with a commissioning between them, likewise. The power fails
/// in every flash operation, in every pause between two, and at random instants from power-on to the last answer.
///
/// Fails if settings are lost.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// More power-ons in a history, and on the board two cuts in a row and more instants; takes some minutes
    #[arg(long)]
    long: bool,
    /// A power-on less in a history, and on the board a random share of the cuts; takes less than a minute
    #[arg(long, conflicts_with = "long")]
    quick: bool,
    /// Seed for the content left by interrupted steps; random if not given
    #[arg(long)]
    seed: Option<u64>,
    /// The chip on the board with the default image
    #[arg(long, default_value = "stm32f405")]
    chip: Part,
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
    let image = testkit::image::build(arguments.chip)?;
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

    let settings = board::Settings::default();
    let firmware = Variant { image: &image, part: arguments.chip, settings };
    let example = Variant { image: testkit::image::example(), part: Part::Stm32f407, settings };
    for (what, variant, sessions) in [
        ("The release image", &firmware, Session::DEFAULT),
        ("The example io", &example, Session::EXAMPLE),
    ] {
        println!("\n{what} for the {}", variant.part.name());
        for session in sessions {
            let course = session.course(variant)?;
            let instants = if arguments.long { INSTANTS_LONG } else { INSTANTS };
            let kinds = [
                ("in every flash operation", course.in_operations(&mut random), arguments.long),
                ("in every pause between them", course.between_operations(&mut random), false),
                ("at random instants", course.at_instants(instants, &mut random), false),
            ];
            for (place, mut cuts, twice) in kinds {
                while arguments.quick && cuts.len() > QUICK {
                    cuts.swap_remove(random.within(0..cuts.len() as u64) as usize);
                }
                let what = format!("{}, {place}", session.name());
                let count = session.run(variant, &cuts, &mut random, twice);
                print(&what, count.with_context(|| what.clone())?);
            }
        }
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
