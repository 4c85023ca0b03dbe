//! `cargo verify storm`: a long series of random frames against the release image.

use std::time::Instant;

use anyhow::bail;
use emulator::{chip::Part, image::Image};
use firmware::device::DEVICE;
use testkit::{
    boards,
    random::Random,
    storm::{Stormed, image::ImageStorm},
};

use xtask::example::{self, Example};

/// The most frames of a storm.
const FRAMES: u64 = 1_000_000_000_000;
/// The lines of progress.
const PARTS: u64 = 10;

/// Send millions of random frames, and check that the image does what the node in the process does
///
/// The frames are requests of LSS, NMT and SDO, slightly wrong ones, and others, also remote and 29-bit frames and
/// lengths of 9 to 15. They go back to back at 1 Mbit/s to the release image on an emulated board, and to the node in
/// the process as its model: the image must give the model's answers and have exactly the same settings in its flash,
/// without a panic, a fault, a reset of its own, or an access that a real chip does not tolerate.
///
/// With an example, requests for its objects by every SDO service, PDOs, SYNC and heartbeats are among the frames, and
/// the node in the process has the same application. The inputs of the board do not change. Effects of time are left
/// out of the comparison: the inhibit times and event timers of TPDOs, missed heartbeats, and two values that change
/// the temperature with the next sample.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// The number of frames
    #[arg(long, default_value_t = 1_000_000, value_parser = clap::value_parser!(u64).range(1..=FRAMES))]
    frames: u64,
    /// Seed of the frames; random if not given
    #[arg(long)]
    seed: Option<u64>,
    /// The chip on the board
    #[arg(long, default_value = testkit::image::PART.name())]
    chip: Part,
    /// Storm an example of a product
    #[arg(long)]
    example: Option<Example>,
}

/// Runs the storm. Panics if anything breaks.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let image = example::image(arguments.chip, arguments.example)?;
    let board = boards::board(arguments.chip, &image, 0);
    let seed = arguments.seed.unwrap_or_else(Random::seed);
    println!("--seed {seed}");
    match arguments.example {
        None => rage(arguments, &image, ImageStorm::new(board, &image, DEVICE, seed)),
        Some(Example::Commissioner) => {
            bail!("no storm knows the objects of this example: choose `io`")
        }
        Some(Example::Io) => {
            rage(arguments, &image, ImageStorm::with_example(board, &image, seed));
        }
    }
    Ok(())
}

fn rage<A: Stormed>(arguments: &Arguments, image: &Image, mut storm: ImageStorm<A>) {
    let begin = Instant::now();
    for part in 0..PARTS {
        let all = arguments.frames;
        storm.rage(all * (part + 1) / PARTS - all * part / PARTS);
        let ImageStorm { frames, stores, resets, switches, pdos, .. } = storm;
        let (virtual_ms, seconds) = (storm.now(), begin.elapsed().as_secs());
        println!(
            "{frames:>12} frames, {stores:>8} stores, {resets} resets, {switches} switches, \
             {pdos} PDOs, {virtual_ms} ms virtual  {seconds:>5} s"
        );
    }
    println!("{:>12} bytes of stack at most", storm.stack_depth(image));
}
