//! A short storm of random frames against the release image; `cargo verify storm` makes long ones.

use firmware::device::DEVICE;
use testkit::{
    image::example,
    storm::image::{ExampleStorm, ImageStorm},
};

use crate::rig::*;

/// The seed of the storms of the image; the number of stores and resets depends on it.
const SEED: u64 = 11;

#[test]
fn in_a_storm_the_image_sends_and_stores_exactly_what_the_node_does() {
    let mut storm = ImageStorm::new(blank_board(0), image(), DEVICE, SEED);
    storm.rage(15_000);
    assert!(storm.stores > 5, "{} stores", storm.stores);
    assert!(storm.resets > 5, "{} resets", storm.resets);
    assert!(storm.switches > 5, "{} switches", storm.switches);
}

#[test]
fn in_a_storm_the_example_sends_and_stores_exactly_what_its_node_does() {
    let board = Board::new(PART, example(), Default::default());
    let mut storm = ExampleStorm::with_example(board, example(), SEED);
    storm.rage(15_000);
    let ExampleStorm { stores, resets, switches, pdos, .. } = storm;
    println!("{stores} stores, {resets} resets, {switches} switches, {pdos} PDOs");
    assert!(stores > 5 && resets > 2 && switches > 2 && pdos > 100);
}
