//! `cargo verify chip-variants`: the image's sessions on each variant of the chip that the manuals allow.

mod matrix;

use std::time::Instant;

use anyhow::ensure;
use emulator::{board, chip::Part};

use testkit::{boards::Variant, parallel, sessions};

/// Run the image's sessions on each variant of the chip that the manuals allow
///
/// The manuals are ambiguous, and some chips behave otherwise than the emulated board does by default. On each of
/// these variants the release image must boot, be found and configured by LSS, switch the bit rate, detect it, store,
/// survive power cuts while it stores, and recover from bus-off. For each variant the table shows success or the first
/// difference.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// Leave out the longest sessions: power cuts, detection on a quiet bus, a rescue, three boards, more switches
    #[arg(long)]
    quick: bool,
    /// The chip on the board
    #[arg(long, default_value = testkit::image::PART.name())]
    chip: Part,
}

/// Prints the table. Fails if a session fails on any variant.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let image = testkit::image::build(arguments.chip)?;
    let begin = Instant::now();
    let sessions = sessions::all(arguments.quick);
    let variants = matrix::variants();
    let try_out = |&(_, settings): &(&str, board::Settings)| -> Option<String> {
        let variant = Variant { image: &image, part: arguments.chip, settings };
        sessions.iter().find_map(|(name, session)| {
            let failure = sessions::outcome(|| session(&variant)).err();
            failure.map(|why| format!("{name}: {why}"))
        })
    };
    let mut failed = 0;
    parallel::map(&variants, try_out, |index, first_failure| {
        failed += usize::from(first_failure.is_some());
        let outcome = first_failure.as_deref().unwrap_or("passed");
        println!("{:62} {outcome}", variants[index].0);
    });
    let (count, sessions) = (variants.len(), sessions.len());
    let seconds = begin.elapsed().as_secs();
    println!("\n{count} variants, {sessions} sessions each: {failed} failed, {seconds} s");
    ensure!(failed == 0, "the image does not work on every variant");
    Ok(())
}
