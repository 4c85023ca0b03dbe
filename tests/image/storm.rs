//! A short storm of random frames against the release image and against the node; `cargo xtask storm` makes long ones.

use testkit::{
    image::image,
    image_rig::blank_board,
    random::Random,
    storm::{image::ImageStorm, node::NodeStorm},
};

#[test]
fn in_a_storm_the_image_sends_and_stores_exactly_what_the_node_does() {
    let mut storm = ImageStorm::new(blank_board(0), image(), Random::from_environment().u64());
    storm.rage(10_000);
    assert!(storm.stores > 5, "{} stores", storm.stores);
    assert!(storm.resets > 5, "{} resets", storm.resets);
    assert!(storm.switches > 5, "{} switches", storm.switches);
}

#[test]
fn no_storm_makes_the_node_store_unasked_or_silences_it() {
    let mut storm = NodeStorm::new(Random::from_environment().u64());
    storm.rage(200_000);
    assert!(storm.stores > 100, "{} stores", storm.stores);
}
