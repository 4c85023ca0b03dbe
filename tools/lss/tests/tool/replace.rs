//! A new board takes over the place of a missing one: `lss assign --table`.

use std::{fs, path::PathBuf};

use canopen_node::BitRate;

use crate::{
    assign::{entry, file, ids},
    emulated::{Boards, Outcome, address_text},
};

const RATE: BitRate = BitRate::Kbit125;

/// A table with this text, and what `lss assign` with it and these further arguments does.
fn assign(boards: &Boards, name: &str, text: &str, arguments: &str) -> (Outcome, PathBuf) {
    let path = file(name, text);
    let outcome = boards.lss(&format!("assign --table {} {arguments}", path.display()));
    boards.assert_waiting(RATE);
    (outcome, path)
}

fn content(path: &PathBuf) -> String {
    fs::read_to_string(path).expect("it is there")
}

fn missing(id: u8, board: usize) -> String {
    format!("node {id} of the table is missing: {}", address_text(board))
}

/// Two boards of which the table knows the one with node-ID 9; board 7, which is not there, has node-ID 5.
fn two_known() -> String {
    format!("# plant 3\n{}# the pump\n{}# end\n", entry(9, 1), entry(5, 7))
}

#[test]
fn the_only_new_board_takes_over_the_place_of_the_only_missing_one() {
    for (name, arguments, person) in
        [("yes.toml", "--yes", None), ("question.toml", "", Some(&["y"][..]))]
    {
        let boards = Boards::new(RATE, &[0xFF, 9]);
        boards.person.set(person);
        let (outcome, path) = assign(&boards, name, &two_known(), arguments);
        assert_eq!((outcome.code, outcome.error.as_str()), (0, ""));
        let (new, old) = (address_text(0), address_text(7));
        assert!(outcome.text.contains(&format!("node 5  {new}  takes over the place of {old}\n")));
        assert!(outcome.text.contains(&format!("node 5  {new}  stored, verified by a reset\n")));
        assert_eq!(ids(&boards, 2), [Some(5), Some(9)]);
        assert_eq!(content(&path), two_known().replace(&old, &new));
        let again = boards.lss(&format!("assign --table {}", path.display()));
        assert_eq!((again.code, again.text.matches("as in the table").count()), (0, 2));
    }
}

#[test]
fn without_yes_and_without_a_person_nothing_changes_for_that_place() {
    let boards = Boards::new(RATE, &[0xFF, 9]);
    let (outcome, path) = assign(&boards, "nobody.toml", &two_known(), "");
    assert_eq!(outcome.code, 1);
    let board = address_text(0);
    let expected = format!(
        "{}. Board {board} is new and of the same product: with --yes it takes over node-ID 5. Nothing was done with it",
        missing(5, 7)
    );
    assert_eq!(outcome.error, expected);
    assert_eq!(ids(&boards, 2), [None, Some(9)]);
    assert_eq!(content(&path), two_known());
    // With --yes it goes on.
    let outcome = boards.lss(&format!("assign --yes --table {}", path.display()));
    assert_eq!((outcome.code, boards.stored(0)), (0, Some((5, 4))));
}

#[test]
fn a_board_that_is_not_to_take_over_gets_a_node_id_of_its_own() {
    let boards = Boards::new(RATE, &[0xFF, 9]);
    boards.person.set(Some(&[""]));
    let (outcome, path) = assign(&boards, "own.toml", &two_known(), "");
    assert_eq!((outcome.code, outcome.error), (1, missing(5, 7)));
    assert_eq!(ids(&boards, 2), [Some(1), Some(9)]);
    assert_eq!(content(&path), format!("{}\n{}", two_known(), entry(1, 0)));
}

#[test]
fn a_missing_board_without_a_new_one_is_only_named() {
    let boards = Boards::new(RATE, &[30, 9]);
    // Node 30 has a place elsewhere.
    let (outcome, path) = assign(&boards, "none.toml", &two_known(), "--yes");
    assert_eq!((outcome.code, outcome.error), (1, missing(5, 7)));
    assert_eq!(ids(&boards, 2), [Some(30), Some(9)]);
    assert_eq!(content(&path), two_known());
}

#[test]
fn of_several_new_boards_the_person_chooses_one() {
    let boards = Boards::new(RATE, &[0xFF, 9, 0xFF]);
    let (outcome, path) = assign(&boards, "several.toml", &two_known(), "--yes");
    assert_eq!(outcome.code, 1);
    let mut new = [0, 2];
    new.sort_by_key(|board| crate::emulated::address(*board).serial_number);
    let words = format!(
        "{}\nnew and of the same product are {}: it is not clear which one takes over, and nothing",
        missing(5, 7),
        new.map(address_text).join(", ")
    );
    assert!(outcome.error.starts_with(&words), "{}", outcome.error);
    assert_eq!(ids(&boards, 3), [None, Some(9), None]);
    assert_eq!(content(&path), two_known());

    boards.person.set(Some(&["2"]));
    let outcome = boards.lss(&format!("assign --table {}", path.display()));
    assert_eq!((outcome.code, outcome.error.as_str()), (0, ""));
    assert_eq!(boards.stored(new[1]), Some((5, 4)));
    assert_eq!(boards.stored(new[0]), Some((1, 4)), "the other one is a new board");
    let expected = two_known().replace(&address_text(7), &address_text(new[1]));
    assert_eq!(content(&path), format!("{expected}\n{}", entry(1, new[0])));
    boards.assert_waiting(RATE);
}

#[test]
fn of_several_missing_boards_the_person_chooses_one() {
    let boards = Boards::new(RATE, &[0xFF, 9]);
    let text = format!("{}{}{}", two_known(), entry(6, 8), entry(7, 6));
    let (outcome, path) = assign(&boards, "places.toml", &text, "--yes");
    assert_eq!(outcome.code, 1);
    let words = format!(
        "{}\n{}\n{}\nnew and of the same product is {}: it is not clear which place it takes over",
        missing(5, 7),
        missing(6, 8),
        missing(7, 6),
        address_text(0)
    );
    assert!(outcome.error.starts_with(&words), "{}", outcome.error);
    assert_eq!((ids(&boards, 2), content(&path)), (vec![None, Some(9)], text.clone()));

    // Not those of nodes 5 and 6; a number that is no choice is none.
    boards.person.set(Some(&["0", "2", "1"]));
    let outcome = boards.lss(&format!("assign --table {}", path.display()));
    assert_eq!((outcome.code, outcome.error), (1, [missing(5, 7), missing(6, 8)].join("\n")));
    assert_eq!(boards.stored(0), Some((7, 4)));
    assert_eq!(content(&path), text.replace(&address_text(6), &address_text(0)));
}

#[test]
fn a_board_that_was_used_before_takes_over_too() {
    // It has the node-ID of the missing one, or that of another board of the table.
    for id in [5, 9] {
        let boards = Boards::new(RATE, &[id, 9]);
        let (outcome, path) = assign(&boards, "used.toml", &two_known(), "--yes");
        assert_eq!((outcome.code, outcome.error.as_str()), (0, ""));
        assert!(!outcome.text.contains("is not in the table"), "{}", outcome.text);
        assert_eq!(ids(&boards, 2), [Some(5), Some(9)]);
        assert_eq!(content(&path), two_known().replace(&address_text(7), &address_text(0)));
        let list = boards.lss("list");
        assert_eq!(list.code, 0, "{}", list.text);
    }
}

#[test]
fn a_place_whose_node_id_another_board_has_is_not_taken_over() {
    // Board 2 has the node-ID of the missing one, and the person does not choose it.
    let boards = Boards::new(RATE, &[0xFF, 9, 5]);
    // Nodes with a node-ID are listed first.
    boards.person.set(Some(&["2"]));
    let (outcome, path) = assign(&boards, "taken-place.toml", &two_known(), "");
    assert_eq!(outcome.code, 1);
    let words = format!("board {} cannot take over node-ID 5, which another", address_text(0));
    assert!(outcome.error.starts_with(&words), "{}", outcome.error);
    assert_eq!(ids(&boards, 3), [None, Some(9), Some(5)]);
    assert_eq!(content(&path), two_known());
    assert_eq!(boards.lss("list").code, 0);
}

#[test]
fn after_ctrl_c_the_table_has_a_board_that_has_stored_its_place() {
    let frames = std::rc::Rc::new(std::cell::Cell::new((0, None)));
    let seen = std::rc::Rc::clone(&frames);
    let boards = Boards::new(RATE, &[0xFF, 9]);
    boards.at_each_frame(move |frame, _| {
        let (count, at) = seen.get();
        let is_configure = frame.cob_id() == 0x7E5 && frame.data().first() == Some(&0x11);
        seen.set((count + 1, at.or(is_configure.then_some(count + 1))));
    });
    assign(&boards, "interrupted.toml", &two_known(), "--yes");
    let configure = frames.get().1.expect("a configuration");
    let mut outcomes = std::collections::BTreeSet::new();
    for number in configure - 2..configure + 4 {
        let boards = Boards::new(RATE, &[0xFF, 9]);
        boards.interrupt_at(number);
        let (outcome, path) = assign(&boards, "interrupted.toml", &two_known(), "--yes");
        assert_eq!(outcome.code, 130);
        let is_stored = boards.stored(0).is_some();
        let expected = match is_stored {
            true => two_known().replace(&address_text(7), &address_text(0)),
            false => two_known(),
        };
        assert_eq!(content(&path), expected, "frame {number}");
        outcomes.insert(is_stored);
    }
    assert_eq!(outcomes.len(), 2, "both sides of the configuration");
}
