//! `lss assign`.

use std::{
    fs,
    path::{Path, PathBuf},
};

use canopen_node::BitRate;
use emulator::Time;
use testkit::cargo;

use crate::{
    emulated::{Boards, address, address_text},
    in_process::{self, Wire},
};

const RATE: BitRate = BitRate::Kbit125;
/// The index of that bit rate.
const INDEX: u8 = 4;

/// A file that does not exist yet.
pub fn new_file(name: &str) -> PathBuf {
    let path = cargo::scratch(name);
    // It exists if the test ran before.
    let _ = fs::remove_file(&path);
    path
}

/// A file with this content.
pub fn file(name: &str, content: impl AsRef<[u8]>) -> PathBuf {
    let path = cargo::scratch(name);
    fs::write(&path, content).expect("it can be written");
    path
}

pub fn entry(id: u8, board: usize) -> String {
    format!("[[node]]\nid = {id}\naddress = \"{}\"\n", address_text(board))
}

/// The stored node-IDs of the boards.
pub fn ids(boards: &Boards, count: usize) -> Vec<Option<u8>> {
    (0..count).map(|board| boards.stored(board).map(|(id, _)| id)).collect()
}

#[test]
fn each_blank_board_gets_a_free_node_id_that_survives_a_power_cut() {
    let boards = Boards::new(RATE, &[2, 0xFF, 0xFF, 4, 0xFF]);
    let outcome = boards.lss("assign");
    assert_eq!(outcome.code, 0);
    // Fastscan finds the lowest serial number first.
    let mut blank = [1, 2, 4];
    blank.sort_by_key(|board| address(*board).serial_number);
    let expected: Vec<String> = [1, 3, 5]
        .iter()
        .zip(blank)
        .map(|(id, board)| {
            format!("node {id}  {}  stored, verified by a reset", address_text(board))
        })
        .collect();
    assert_eq!(outcome.text.lines().collect::<Vec<_>>(), expected);
    for (id, board) in [1, 3, 5].into_iter().zip(blank) {
        assert_eq!(boards.stored(board), Some((id, INDEX)));
    }
    boards.assert_waiting(RATE);
    for board in 0..5 {
        boards.rig().power_cycle(board);
    }
    let list = boards.lss("list");
    assert_eq!((list.code, list.text.lines().count()), (0, 6));
    assert!(!list.text.contains("none"));
    assert_eq!(boards.lss("assign").text, "no board needs a node-ID\n");
}

#[test]
fn node_ids_begin_at_the_first_and_may_run_out() {
    let boards = Boards::new(RATE, &[0xFF, 0xFF]);
    let outcome = boards.lss("assign --first 127");
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.contains("needs a node-ID, but none from 127 on is free"));
    let mut stored = ids(&boards, 2);
    stored.sort();
    assert_eq!(stored, [None, Some(127)]);
    boards.assert_waiting(RATE);
}

#[test]
fn the_boards_of_a_table_get_their_node_ids_and_new_ones_come_into_it() {
    let boards = Boards::new(RATE, &[0xFF, 0xFF, 30, 9]);
    let text = format!("# a network\n{}{}{}", entry(20, 1), entry(31, 2), entry(9, 3));
    let path = file("network.toml", &text);
    let outcome = boards.lss(&format!("assign --table {}", path.display()));
    assert_eq!(outcome.code, 0);
    assert_eq!(ids(&boards, 4), [Some(1), Some(20), Some(31), Some(9)]);
    assert!(outcome.text.contains(&format!("node 9  {}  as in the table\n", address_text(3))));
    let grown = fs::read_to_string(&path).expect("it is there");
    assert_eq!(grown, format!("{text}\n{}", entry(1, 0)));
    let again = boards.lss(&format!("assign --table {}", path.display()));
    assert_eq!((again.code, again.text.matches("as in the table").count()), (0, 4));
    boards.assert_waiting(RATE);
}

#[test]
fn a_board_with_a_node_id_that_the_table_lacks_is_named_and_gets_no_entry() {
    let name = |id: u8, board: usize| {
        format!("node {id}  {}  is not in the table: ", in_process::address_text(board))
    };
    let known = format!("[[node]]\nid = 9\naddress = \"{}\"\n", in_process::address_text(1));
    for (text, expected) in [
        ("", vec![name(9, 1), name(30, 0)]),
        (&known, vec![name(30, 0)]),
        // Whichever board has that node-ID.
        ("[[node]]\nid = 30\n", vec![name(9, 1)]),
    ] {
        let boards = Wire::new(RATE, &[30, 9]);
        let path = file("lacks.toml", text);
        let outcome = boards.lss(&format!("assign --table {}", path.display()));
        assert_eq!((outcome.code, &*outcome.error), (0, ""));
        let lines = outcome.text.lines().filter(|line| line.contains("is not in the table"));
        let lines: Vec<&str> = lines.collect();
        assert_eq!(lines.len(), expected.len(), "{lines:?}");
        assert!(lines.iter().zip(&expected).all(|(line, words)| line.starts_with(words)));
        assert_eq!(fs::read_to_string(&path).expect("it is there"), text);
        for line in lines {
            let advice = line.split_once("(lss ").and_then(|(_, rest)| rest.split_once(')'));
            assert_eq!(boards.lss(advice.expect("a command").0).code, 0, "{line}");
        }
    }
    assert!(!Wire::new(RATE, &[30]).lss("assign").text.contains("table"));
}

#[test]
fn a_missing_board_of_a_table_is_named_and_keeps_its_node_id() {
    let boards = Boards::new(RATE, &[0xFF, 9]);
    let path = new_file("missing.toml");
    // It is of another product: no board that is here can take over its place.
    let missing = "00000000:00000001:00010000:515884C7";
    let text = format!("[[node]]\nid = 1\naddress = \"{missing}\"\n");
    fs::write(&path, text).expect("it can be written");
    let outcome = boards.lss(&format!("assign --table {}", path.display()));
    assert_eq!(outcome.code, 1);
    assert_eq!(outcome.error, format!("node 1 of the table is missing: {missing}"));
    assert_eq!(boards.stored(0), Some((2, INDEX)));
    boards.assert_waiting(RATE);
}

#[test]
fn a_node_id_of_the_table_that_another_board_has_is_not_given_twice() {
    let boards = Boards::new(RATE, &[0xFF, 9]);
    let path = file("taken.toml", entry(9, 0));
    let outcome = boards.lss(&format!("assign --table {}", path.display()));
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.starts_with("another board has node-ID 9"), "{}", outcome.error);
    assert_eq!(ids(&boards, 2), [None, Some(9)]);
    // No second entry for the board.
    assert_eq!(fs::read_to_string(&path).expect("it is there"), entry(9, 0));
    boards.assert_waiting(RATE);
}

#[test]
fn a_wrong_table_changes_nothing() {
    let boards = Boards::new(RATE, &[0xFF]);
    let path = new_file("wrong.toml");
    let id: &[u8] = b"[[node]]\nid = 200\naddress = \"1:2:3:4\"\n";
    for (text, why) in [(id, "200 is no node-ID"), (b"\xFF", "did not contain valid UTF-8")] {
        fs::write(&path, text).expect("it can be written");
        let outcome = boards.lss(&format!("assign --table {}", path.display()));
        assert_eq!(outcome.code, 1);
        assert!(outcome.error.ends_with(why), "{}", outcome.error);
    }
    assert_eq!(boards.stored(0), None);
}

#[test]
fn after_ctrl_c_each_board_that_has_a_node_id_has_stored_it() {
    // Around the end of the first scan, with the configuration.
    let boards = Boards::new(RATE, &[0xFF, 0xFF]);
    let configure = std::rc::Rc::new(std::cell::Cell::new((0, 0)));
    let seen = std::rc::Rc::clone(&configure);
    boards.at_each_frame(move |frame, _| {
        let (count, at) = seen.get();
        let is_first = at == 0 && frame.data().first() == Some(&0x11);
        seen.set((count + 1, if is_first { count + 1 } else { at }));
    });
    assert_eq!(boards.lss("assign").code, 0);
    let (_, configure) = configure.get();
    for number in configure - 4..configure + 6 {
        let boards = Boards::new(RATE, &[0xFF, 0xFF]);
        boards.interrupt_at(number);
        assert_eq!(boards.lss("assign").code, 130, "frame {number}");
        boards.assert_waiting(RATE);
        let stored = ids(&boards, 2).into_iter().flatten().count();
        let list = boards.lss("list").text;
        assert_eq!(list.matches("LSS slave").count(), stored, "frame {number}: {list}");
        assert_eq!(boards.lss("assign").code, 0);
    }
}

#[test]
fn a_board_without_power_during_its_configuration_is_named() {
    let boards = Boards::new(RATE, &[0xFF]);
    boards.at_each_frame(|frame, network| {
        if frame.data().first() == Some(&0x11) {
            network.power_off(0);
        }
    });
    let outcome = boards.lss("assign");
    assert_eq!(outcome.code, 1);
    assert_eq!(
        outcome.error,
        format!("board {}: no answer to configure node-ID: 1", address_text(0))
    );
    boards.at_each_frame(|_, _| ());
    boards.rig().power_on(0);
    boards.rig().network.run_for(Time::from_ms(100));
    assert_eq!(boards.lss("assign").code, 0);
}

#[test]
fn a_board_without_fastscan_is_told_and_can_be_given_a_node_id() {
    let boards = Boards::new(RATE, &[0xFF, 9]);
    boards.unsupported.set(Some(0x51));
    let outcome = boards.lss("assign");
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.contains("does not answer to Fastscan"), "{}", outcome.error);
    let list = boards.lss("list");
    assert!(list.text.contains("\nnone     -  "), "{}", list.text);
    assert!(list.text.ends_with("  125\n"), "{}", list.text);
    let outcome = boards.lss("set-rate 500");
    assert!(outcome.error.starts_with("a board without a node-ID does not tell its LSS address"));
    assert_eq!(boards.lss(&format!("set-id 5 --store --address {}", address_text(0))).code, 0);
    assert_eq!(boards.lss("assign").text, "no board needs a node-ID\n");
}

#[test]
fn no_board_gets_a_node_id_that_the_table_cannot_keep() {
    let text = format!("node = [{{ id = 5, address = \"{}\" }}]\n", address_text(0));
    let inline = file("inline.toml", &text);
    for (table, why) in [
        (Path::new("/nowhere/network.toml"), "/nowhere/network.toml: cannot write: "),
        (&*inline, "inline.toml: with one more [[node]] at its end: "),
    ] {
        let boards = Boards::new(RATE, &[5, 0xFF]);
        let outcome = boards.lss(&format!("assign --table {}", table.display()));
        assert_eq!((outcome.code, boards.stored(1)), (1, None), "{}", outcome.error);
        assert!(outcome.error.contains(why), "{}", outcome.error);
        assert!(outcome.error.ends_with(&format!(". Board {} got no node-ID", address_text(1))));
        boards.assert_waiting(RATE);
    }
    assert_eq!(fs::read_to_string(&inline).expect("it is there"), text);
}

#[cfg(unix)]
#[test]
fn a_table_that_is_a_link_stays_one_and_keeps_its_mode() {
    use std::os::unix::fs::{PermissionsExt, symlink};
    // A new board, and one that takes over a place.
    for (text, expected) in [
        (entry(9, 1), format!("{}\n{}", entry(9, 1), entry(1, 0))),
        (entry(9, 1) + &entry(5, 7), entry(9, 1) + &entry(5, 0)),
    ] {
        let (link, file) = (new_file("link.toml"), new_file("linked.toml"));
        fs::write(&file, &text).expect("it can be written");
        fs::set_permissions(&file, fs::Permissions::from_mode(0o604)).expect("a mode");
        symlink("linked.toml", &link).expect("a link");
        let boards = Boards::new(RATE, &[0xFF, 9]);
        assert_eq!(boards.lss(&format!("assign --yes --table {}", link.display())).code, 0);
        assert!(fs::symlink_metadata(&link).expect("it is there").is_symlink());
        let metadata = fs::symlink_metadata(&file).expect("it is there");
        assert_eq!(metadata.permissions().mode() & 0o777, 0o604);
        assert_eq!(fs::read_to_string(&file).expect("it is there"), expected);
        assert!(!file.with_file_name("linked.toml.new").exists());
    }
}

#[test]
fn a_board_that_refuses_its_node_id_does_not_come_into_the_table() {
    let boards = Boards::new(RATE, &[0xFF]);
    boards.unsupported.set(Some(0x17));
    let path = new_file("refused.toml");
    assert_eq!(boards.lss(&format!("assign --table {}", path.display())).code, 1);
    assert!(!path.exists() && !path.with_file_name("refused.toml.new").exists());
}
