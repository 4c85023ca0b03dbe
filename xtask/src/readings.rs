//! `cargo xtask readings`: the image's sessions under each doubtful reading of the manuals.

pub mod bus;
mod matrix;
pub mod sessions;

use std::time::Instant;

use anyhow::ensure;
use emulator::chip::Part;

use crate::parallel;
use bus::Variant;
use matrix::Reading;

/// Run the image's sessions under each doubtful reading of the manuals
///
/// The manuals are ambiguous, and some chips behave otherwise than the emulated board does by default. Under each of
/// these readings the release image must boot, be found and configured by LSS, switch the bit rate, detect it, store,
/// survive power cuts while it stores, and recover from bus-off. For each reading the table shows success or the first
/// difference.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// Leave out the longest sessions: power cuts, detection on a quiet bus, a rescue, three boards, more switches
    #[arg(long)]
    quick: bool,
    /// The chip on the board
    #[arg(long, default_value = "stm32f405")]
    chip: Part,
}

/// Prints the table. Fails if a session fails under any reading.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let image = testkit::image::build(arguments.chip)?;
    let begin = Instant::now();
    let sessions = sessions::all(arguments.quick);
    let readings = matrix::readings();
    let try_out = |reading: &Reading| -> Option<String> {
        let variant = Variant { image: &image, part: arguments.chip, settings: reading.settings };
        sessions.iter().find_map(|(name, session)| {
            session(&variant).err().map(|error| format!("{name}: {error:#}"))
        })
    };
    let mut failed = 0;
    parallel::map(&readings, try_out, |index, first_failure| {
        failed += usize::from(first_failure.is_some());
        let outcome = first_failure.as_deref().unwrap_or("passed");
        println!("{:62} {outcome}", readings[index].name);
    });
    let (count, sessions) = (readings.len(), sessions.len());
    let seconds = begin.elapsed().as_secs();
    println!("\n{count} readings, {sessions} sessions each: {failed} failed, {seconds} s");
    ensure!(failed == 0, "the image does not work under every reading");
    Ok(())
}
