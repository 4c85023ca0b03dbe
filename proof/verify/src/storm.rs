//! `cargo verify storm`: a long series of random frames against the node in the process and against the release image.

use std::time::Instant;

use anyhow::{bail, ensure};
use emulator::{chip::Part, image::Image};
use firmware::device::DEVICE;
use testkit::{
    boards,
    random::Random,
    storm::{Stormed, image::ImageStorm, node::NodeStorm},
};

use xtask::example::{self, Example};

/// The most frames of a storm.
const FRAMES: u64 = 1_000_000_000_000;
/// Lines of progress of each storm.
const PARTS: u64 = 10;

/// Send millions of random frames, and check that nothing breaks and nothing is stored without a request
///
/// The frames are requests of LSS, NMT and SDO, slightly wrong ones, and others, also remote and 29-bit frames and
/// lengths of 9 to 15. First they go to the node in the process; then, back to back at 1 Mbit/s, to the release image
/// on an emulated board and to the node as its model: the image must give the model's answers and have exactly the same
/// settings in its flash, without a panic, a fault, a reset of its own, or an access that a real chip does not
/// tolerate. Both must answer at the end.
///
/// With an example, requests for its objects by every SDO service, PDOs, SYNC and heartbeats are among the frames, and
/// the node in the process has the same application. The inputs of the board do not change. Effects of time are left
/// out of the comparison: the inhibit times and event timers of TPDOs, missed heartbeats, and two values that change
/// the temperature with the next sample.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// Frames to the node in the process
    #[arg(long, default_value_t = 10_000_000, value_parser = clap::value_parser!(u64).range(..=FRAMES))]
    frames: u64,
    /// Frames to the release image
    #[arg(long, default_value_t = 1_000_000, value_parser = clap::value_parser!(u64).range(..=FRAMES))]
    image_frames: u64,
    /// Seed of the frames; random if not given
    #[arg(long)]
    seed: Option<u64>,
    /// The chip on the board [default: stm32f405, or that of the example]
    #[arg(long)]
    chip: Option<Part>,
    /// Storm an example of a product
    #[arg(long)]
    example: Option<Example>,
}

/// Runs both storms. Panics if anything breaks.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    ensure!(
        arguments.frames + arguments.image_frames > 0,
        "a storm needs --frames or --image-frames above 0"
    );
    let chip = example::chip(arguments.chip, arguments.example);
    let image = example::image(chip, arguments.example)?;
    let board = boards::board(chip, &image, 0);
    let seed = arguments.seed.unwrap_or_else(Random::seed);
    println!("--seed {seed}");
    match arguments.example {
        None => {
            rage_at_node(arguments, NodeStorm::new(seed));
            rage_at_image(arguments, &image, ImageStorm::new(board, &image, DEVICE, seed));
        }
        Some(Example::Thermo) => bail!("no storm knows the objects of `thermo`: choose `io`"),
        Some(Example::Io) => {
            rage_at_node(arguments, NodeStorm::with_example(seed));
            rage_at_image(arguments, &image, ImageStorm::with_example(board, &image, seed));
        }
    }
    Ok(())
}

fn rage_at_node<A: Stormed, const T: usize, const R: usize, const P: usize>(
    arguments: &Arguments,
    mut storm: NodeStorm<A, T, R, P>,
) {
    println!("\nThe node in the process");
    in_parts(arguments.frames, |part| {
        storm.rage(part);
        let NodeStorm { frames, stores, pdos, .. } = storm;
        format!("{frames:>12} frames, {stores:>8} stores, {pdos} PDOs")
    });
}

fn rage_at_image<A: Stormed, const T: usize, const R: usize, const P: usize>(
    arguments: &Arguments,
    image: &Image,
    mut storm: ImageStorm<A, T, R, P>,
) {
    let chip = example::chip(arguments.chip, arguments.example);
    println!("\nThe release image for the {}", chip.name());
    in_parts(arguments.image_frames, |part| {
        storm.rage(part);
        let ImageStorm { frames, stores, resets, switches, pdos, .. } = storm;
        let virtual_ms = storm.now();
        format!(
            "{frames:>12} frames, {stores:>8} stores, {resets} resets, {switches} switches, \
             {pdos} PDOs, {virtual_ms} ms virtual"
        )
    });
    println!("{:>12} bytes of stack at most", storm.stack_depth(image));
}

/// Divides `frames` into parts, and prints what `rage` says of each, with the time so far.
fn in_parts(frames: u64, mut rage: impl FnMut(u64) -> String) {
    let begin = Instant::now();
    for part in 0..PARTS {
        let counts = rage(frames * (part + 1) / PARTS - frames * part / PARTS);
        println!("{counts}  {:>5} s", begin.elapsed().as_secs());
    }
}
