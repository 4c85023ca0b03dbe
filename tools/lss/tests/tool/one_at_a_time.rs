//! `lss assign --one-at-a-time`: a person holds a board, and learns which it is.

use std::sync::Arc;

use can_bus::person::Person;
use canopen_node::BitRate;
use testkit::slave_bus::Defect;

use crate::{
    assign::file,
    emulated::run,
    in_process::{Wire, address_text},
};

const RATE: BitRate = BitRate::Kbit125;

/// Boards with these node-IDs that are not on the bus yet.
fn boards(ids: &[u8]) -> Wire {
    let wire = Wire::new(RATE, ids);
    (0..ids.len()).for_each(|board| wire.pull_out(board));
    wire
}

/// The lines about nodes.
fn nodes(text: &str) -> Vec<&str> {
    text.lines().filter(|line| line.starts_with("node ")).collect()
}

fn verified(id: u8, board: usize) -> String {
    format!("node {id}  {}  stored, verified by a reset", address_text(board))
}

#[test]
fn each_board_that_is_plugged_in_gets_the_next_node_id_and_is_named() {
    let wire = boards(&[0xFF, 0xFF, 20, 0xFF]);
    // Two are pulled out again, and nobody else gets their node-IDs.
    for (at, board, is_there) in
        [(5, 3, true), (20, 3, false), (30, 0, true), (45, 0, false), (60, 2, true), (90, 1, true)]
    {
        wire.hand(at, board, is_there);
    }
    let outcome = wire.lss("assign --one-at-a-time --first 8");
    assert_eq!(outcome.code, 0, "{}", outcome.error);
    let known = format!("node 20  {}  has this node-ID already", address_text(2));
    assert_eq!(nodes(&outcome.text), [verified(8, 3), verified(9, 0), known, verified(10, 1)]);
    assert!(outcome.text.starts_with("plug in the next board, within 120 s; Enter ends\n"));
    assert!((200..240).contains(&wire.seconds()), "{} s", wire.seconds());
    wire.assert_waiting();
}

#[test]
fn a_board_of_the_table_gets_its_own_node_id_after_a_new_one() {
    let entry = format!("[[node]]\nid = 30\naddress = \"{}\"\n", address_text(1));
    let table = file("one-at-a-time.toml", entry);
    let wire = boards(&[0xFF, 0xFF]);
    wire.hand(5, 0, true);
    wire.hand(30, 1, true);
    let outcome = wire.lss(&format!("assign --one-at-a-time --table {}", table.display()));
    assert_eq!(outcome.code, 0, "{}", outcome.error);
    assert_eq!(nodes(&outcome.text), [verified(1, 0), verified(30, 1)]);
}

#[test]
fn of_several_boards_that_are_plugged_in_none_is_taken() {
    let wire = boards(&[0xFF, 0xFF]);
    for (at, board, is_there) in [(5, 0, true), (6, 1, true), (30, 0, false), (50, 0, true)] {
        wire.hand(at, board, is_there);
    }
    wire.hand(0, 0, true);
    wire.hand(0, 1, true);
    let outcome = wire.lss("assign --one-at-a-time");
    assert_eq!(outcome.code, 0, "{}", outcome.error);
    let words = format!(
        "several boards have no node-ID: {}, {}. Leave one of them\n",
        address_text(0),
        address_text(1)
    );
    assert_eq!(outcome.text.matches(&words).count(), 1, "{}", outcome.text);
    assert_eq!(nodes(&outcome.text), [verified(1, 1), verified(2, 0)]);
}

#[test]
fn a_bad_board_is_told_at_once_and_the_next_one_is_served() {
    let wire = boards(&[0xFF, 0xFF]);
    wire.bus().slaves[0].defect = Some(Defect::Refuses(&[0x17]));
    wire.hand(5, 0, true);
    wire.hand(30, 1, true);
    let outcome = wire.lss("assign --one-at-a-time");
    assert_eq!(outcome.code, 1);
    let bad = format!("! board {}: store configuration is refused", address_text(0));
    let good = verified(2, 1);
    let at = |words: &str| outcome.text.find(words).expect("it is told");
    assert!(at(&bad) < at(&good), "{}", outcome.text);
    assert!(outcome.error.starts_with(&bad[2..]), "{}", outcome.error);
}

#[test]
fn enter_ends_the_wait_for_a_board() {
    let wire = boards(&[]);
    let outcome =
        run(Box::new(wire.clone()), &Arc::default(), "assign --one-at-a-time", |session| {
            session.person = Person::who_says(&[""]);
        });
    assert_eq!((outcome.code, &*outcome.error), (3, "no board was plugged in"));
    assert!(wire.seconds() < 10, "{} s", wire.seconds());
}
