//! `cargo xtask readings`: the image's sessions under each doubtful reading of the manuals.

mod matrix;
mod rig;
mod sessions;

use std::time::Instant;

use anyhow::ensure;
use emulator::{chip::Part, image::Image};

use crate::boards;
use rig::Rig;

/// Run the image's sessions once under each doubtful reading of what a chip does
///
/// Manuals leave open, and chips were seen to do, what the emulated board does not do by default. Under each of these readings the
/// release image must boot, be found and configured by LSS, switch the bit rate, detect it, store, bear power cuts while it stores,
/// and recover from bus-off. The table says for each reading whether it does, or what differed first.
#[derive(clap::Args)]
pub struct Arguments {
    /// Leave out the power cuts, the detection on a quiet bus and the switches between other rates
    #[arg(long)]
    quick: bool,
    /// The chip on the board
    #[arg(long, default_value = "stm32f405", value_parser = boards::part())]
    chip: Part,
}

/// Prints the table. Fails if a session does under any reading.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let image = Image::build(arguments.chip)?;
    let begin = Instant::now();
    let sessions = sessions::all(arguments.quick);
    let mut failed = 0;
    let readings = matrix::readings();
    for reading in &readings {
        let rig = Rig { image: &image, part: arguments.chip, settings: reading.settings };
        let failures = sessions.iter().filter_map(|(name, session)| {
            session(&rig).err().map(|error| format!("{name}: {error:#}"))
        });
        let first = failures.into_iter().next();
        failed += usize::from(first.is_some());
        println!("{:62} {}", reading.name, first.as_deref().unwrap_or("passed"));
    }
    let (count, sessions) = (readings.len(), sessions.len());
    let seconds = begin.elapsed().as_secs();
    println!("\n{count} readings, {sessions} sessions each: {failed} failed, {seconds} s");
    ensure!(failed == 0, "the image does not work under every reading");
    Ok(())
}
