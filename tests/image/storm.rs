//! A short storm of random frames against the release image and against the node; `cargo verify storm` makes long ones.

use firmware::device::DEVICE;
use testkit::{
    image::example,
    storm::{
        image::{ExampleStorm, ImageStorm},
        node::{ExampleNodeStorm, NodeStorm},
    },
};

use crate::rig::*;

/// The seed of the storms of the image; the number of stores and resets depends on it.
const SEED: u64 = 11;

#[test]
fn in_a_storm_the_image_sends_and_stores_exactly_what_the_node_does() {
    let mut storm = ImageStorm::new(blank_board(0), image(), DEVICE, SEED);
    storm.rage(40_000);
    assert!(storm.stores > 5, "{} stores", storm.stores);
    assert!(storm.resets > 5, "{} resets", storm.resets);
    assert!(storm.switches > 5, "{} switches", storm.switches);
}

#[test]
fn in_a_storm_the_example_sends_and_stores_exactly_what_its_node_does() {
    let board = Board::new(Part::Stm32f407, example(), Default::default());
    let mut storm = ExampleStorm::with_example(board, example(), SEED);
    storm.rage(60_000);
    let ExampleStorm { stores, resets, switches, pdos, .. } = storm;
    println!("{stores} stores, {resets} resets, {switches} switches, {pdos} PDOs");
    assert!(stores > 5 && resets > 2 && switches > 2 && pdos > 100);
}

#[test]
fn no_storm_makes_the_node_store_unasked_or_silences_it() {
    let mut storm = NodeStorm::new(Random::from_environment().u64());
    storm.rage(200_000);
    assert!(storm.stores > 100, "{} stores", storm.stores);
}

#[test]
fn no_storm_makes_the_example_store_or_answer_unasked_or_silences_it() {
    let mut storm = ExampleNodeStorm::with_example(Random::from_environment().u64());
    storm.rage(100_000);
    let ExampleNodeStorm { stores, pdos, .. } = storm;
    println!("{stores} stores, {pdos} PDOs");
    assert!(stores > 100 && pdos > 1_000);
}
