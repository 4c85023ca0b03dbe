//! Boards that do not do what they must, and what an earlier run has left: no board goes silent, and none is passed over.

use std::fs;

use canopen_node::{BitRate, Frame};
use testkit::{flash::Operation, slave_bus::Defect};

use crate::{
    assign::{file, new_file},
    in_process::{At, Fault, Wire, address_text},
};

const RATE: BitRate = BitRate::Kbit125;
const VERIFIED: &str = "stored, verified by a reset";

fn entry(id: u8, board: usize) -> String {
    format!("[[node]]\nid = {id}\naddress = \"{}\"\n", address_text(board))
}

/// Boards with these node-IDs in LSS configuration state, where node-ID 1 is pending and not stored.
fn with_pending(ids: &[u8]) -> Wire {
    let wire = Wire::new(RATE, ids);
    for raw in ["raw 04 01", "raw 11 01"] {
        assert_eq!(wire.lss(raw).code, 0);
    }
    wire
}

/// Asserts that these boards have stored node-IDs of their own, and are nodes with them after a power cut.
#[track_caller]
fn assert_stored(wire: &Wire, boards: &[usize]) {
    wire.power_cycle();
    let ids = wire.ids();
    for board in boards {
        let (active, stored) = ids[*board];
        assert!(active.is_some() && active == stored, "board {board}: {ids:?}");
    }
}

#[test]
fn a_bad_board_is_named_and_all_others_are_finished_in_each_run() {
    let defects = [
        (Defect::Refuses(&[0x11]), "configure node-ID: 2 is refused: "),
        (Defect::Refuses(&[0x17]), "store configuration is refused: "),
        (Defect::DeniesItsStore, "store configuration is refused: the storage medium failed"),
        (Defect::DiesAtStore, "no answer to store configuration"),
        (Defect::Disobeys, "it accepted node-ID 2, but has none"),
        (Defect::Forgets, "it stored node-ID 2, but has none after a reset"),
    ];
    for (defect, words) in defects {
        // The second one that is found, and the first.
        for bad in [1, 0] {
            let wire = Wire::new(RATE, &[0xFF; 5]);
            wire.bus().slaves[bad].defect = Some(defect);
            let words = words.replace('2', &(bad + 1).to_string());
            let others: Vec<usize> = (0..5).filter(|board| *board != bad).collect();
            let start = format!("board {}: {words}", address_text(bad));
            let first = wire.lss("assign");
            assert_eq!(first.code, 1, "{defect:?}");
            assert!(first.error.starts_with(&start), "{defect:?}: {}", first.error);
            assert_eq!(first.text.matches(VERIFIED).count(), 4, "{defect:?}: {}", first.text);
            assert_stored(&wire, &others);
            wire.mend();
            assert_eq!(wire.ids()[bad], (None, None), "{defect:?}");
            // A further run finds the same board first.
            let again = wire.lss("assign");
            assert_eq!(again.code, 1, "{defect:?}");
            assert!(again.error.contains(&address_text(bad)), "{defect:?}: {}", again.error);
            wire.mend();
            wire.bus().slaves[bad].defect = None;
            assert_eq!(wire.lss("assign").code, 0, "{defect:?}");
            assert_stored(&wire, &[0, 1, 2, 3, 4]);
            wire.assert_waiting();
        }
    }
}

#[test]
fn several_bad_boards_are_all_named_and_new_ones_are_found_behind_them() {
    let wire = Wire::new(RATE, &[0xFF; 6]);
    for (board, defect) in
        [(0, Defect::Forgets), (2, Defect::Disobeys), (3, Defect::Refuses(&[0x17]))]
    {
        wire.bus().slaves[board].defect = Some(defect);
    }
    let outcome = wire.lss("assign");
    assert_eq!((outcome.code, outcome.error.lines().count()), (1, 3), "{}", outcome.error);
    for board in [0, 2, 3] {
        assert!(outcome.error.contains(&address_text(board)), "{}", outcome.error);
    }
    assert_stored(&wire, &[1, 4, 5]);
    wire.assert_waiting();
}

#[test]
fn a_bad_board_among_many_costs_seconds() {
    for defect in [Defect::Refuses(&[0x11]), Defect::DiesAtStore, Defect::Forgets] {
        let wire = Wire::new(RATE, &[0xFF; 40]);
        wire.bus().slaves[0].defect = Some(defect);
        let outcome = wire.lss("assign");
        assert_eq!((outcome.code, outcome.text.matches(VERIFIED).count()), (1, 39), "{defect:?}");
        assert!(wire.seconds() < 40, "{defect:?}: {} s", wire.seconds());
    }
}

#[test]
fn a_board_whose_flash_fails_is_named_and_all_others_are_finished() {
    let wire = Wire::new(RATE, &[0xFF; 3]);
    wire.bus().slaves[0].rig.flash.fail(Operation::Write);
    let outcome = wire.lss("assign");
    let words = "store configuration is refused: the storage medium failed";
    assert_eq!(outcome.code, 1);
    assert_eq!(outcome.error, format!("board {}: {words}", address_text(0)));
    assert_eq!(outcome.text.matches(VERIFIED).count(), 2);
}

#[test]
fn a_bad_board_of_a_table_is_named_and_all_others_are_finished() {
    for defect in [Defect::Refuses(&[0x17]), Defect::DiesAtStore, Defect::Disobeys, Defect::Forgets]
    {
        let table = new_file("bad.toml");
        let text = entry(7, 0) + &entry(8, 1);
        for command in ["assign --table", "apply"] {
            fs::write(&table, &text).expect("it can be written");
            let wire = Wire::new(RATE, &[0xFF, 9]);
            wire.bus().slaves[0].defect = Some(defect);
            let outcome = wire.lss(&format!("{command} {}", table.display()));
            assert_eq!(outcome.code, 1, "{command} {defect:?}");
            assert!(outcome.error.contains(&address_text(0)), "{command}: {}", outcome.error);
            assert_eq!(wire.ids()[1], (Some(8), Some(8)), "{command} {defect:?}");
            wire.mend();
            wire.power_cycle();
            assert_eq!(wire.ids()[0], (None, None), "{command} {defect:?}");
            wire.assert_waiting();
            // What it left is beside the table.
            let _ = fs::remove_file(table.with_file_name("bad.toml.unfinished"));
        }
    }
}

#[test]
fn node_ids_that_run_out_are_told_for_each_board_without_one() {
    let wire = Wire::new(RATE, &[0xFF; 5]);
    let outcome = wire.lss("assign --first 126");
    assert_eq!((outcome.code, outcome.text.matches(VERIFIED).count()), (1, 2));
    let line = |board: usize| {
        format!("board {} needs a node-ID, but none from 126 on is free", address_text(board))
    };
    assert_eq!(outcome.error, [2, 3, 4].map(line).join("\n"));
    assert_stored(&wire, &[0, 1]);
    wire.assert_waiting();
}

#[test]
fn after_ctrl_c_what_was_done_is_printed_and_a_bad_board_is_named() {
    // The node-IDs of the first and of the last board, by the numbers of their frames.
    let network = || {
        let wire = Wire::new(RATE, &[0xFF; 4]);
        wire.bus().slaves[1].defect = Some(Defect::Refuses(&[0x17]));
        wire
    };
    let wire = network();
    assert_eq!(wire.lss("assign").code, 1);
    let number = |id: u8| {
        let record = wire.record();
        record.sent.iter().position(|frame| frame.data().starts_with(&[0x11, id]))
    };
    let (first, last) = (number(1).expect("the first"), number(4).expect("the last"));
    let wire = network();
    wire.fail_at(At::Frame(last - first - 8), Fault::CtrlC);
    let outcome = wire.lss("assign");
    assert_eq!(outcome.code, 130);
    assert_eq!(outcome.text.matches(VERIFIED).count(), 2, "{}", outcome.text);
    assert!(outcome.text.contains(&format!("! board {}: ", address_text(1))), "{}", outcome.text);
    wire.assert_waiting();
    assert!(wire.ids().iter().all(|(active, stored)| active == stored), "{:?}", wire.ids());
}

#[test]
fn a_node_id_that_nobody_stored_is_taken_back_before_it_takes_effect() {
    for between in [None, Some("list"), Some("inquire"), Some("identify --vendor 0 --product 0")] {
        let wire = with_pending(&[0xFF]);
        if let Some(command) = between {
            wire.lss(command);
        }
        assert_eq!(wire.lss("assign").code, 0);
        assert_stored(&wire, &[0]);
    }
}

#[test]
fn a_node_id_that_nobody_stored_is_taken_back_before_apply() {
    let table = file("left.toml", entry(1, 0));
    let wire = with_pending(&[0xFF]);
    assert_eq!(wire.apply(&table, "").0.code, 0);
    assert_stored(&wire, &[0]);
}

#[test]
fn nodes_in_configuration_state_keep_the_node_ids_that_they_have() {
    for (before, after) in [(&[5, 0xFF, 7][..], &[5, 1, 7][..]), (&[5, 7], &[5, 7]), (&[5], &[5])] {
        let wire = with_pending(before);
        assert_eq!(wire.lss("assign").code, 0);
        // As an NMT master does at its start.
        (0..before.len()).for_each(|board| wire.nmt(board, "82 00"));
        let after: Vec<_> = after.iter().map(|id| (Some(*id), Some(*id))).collect();
        assert_eq!(wire.ids(), after);
    }
}

#[test]
fn after_the_adapter_was_gone_at_any_frame_a_further_run_stores_all() {
    for fault in [Fault::AdapterGone, Fault::AdapterGoneBehind, Fault::CtrlC] {
        // From the configuration of a board to the search for the next.
        for frame in 0..10 {
            let wire = Wire::new(RATE, &[0xFF, 0xFF]);
            wire.fail_at(At::Frame(frame), fault);
            let what = format!("{fault:?} at frame {frame}");
            wire.lss("assign");
            assert!(wire.mend(), "{what}");
            assert_eq!(wire.lss("assign").code, 0, "{what}");
            assert_stored(&wire, &[0, 1]);
            wire.assert_waiting();
        }
    }
}

#[test]
fn a_node_id_that_is_taken_back_is_taken_out_of_the_flash_too() {
    let table = file("back.toml", entry(7, 0));
    let with_table = format!("assign --table {}", table.display());
    let apply = format!("apply {}", table.display());
    let set = format!("set-id 7 --store --address {}", address_text(0));
    let reset = format!("{set} --reset");
    for (command, before) in [
        ("assign --first 7", None),
        (&*with_table, None),
        (&*with_table, Some(3)),
        (&*apply, None),
        (&*apply, Some(3)),
        (&*set, None),
        (&*set, Some(3)),
        (&*reset, Some(3)),
    ] {
        let wire = Wire::new(RATE, &[before.unwrap_or(0xFF)]);
        wire.bus().slaves[0].defect = Some(Defect::DeniesItsStore);
        assert_eq!(wire.lss(command).code, 1, "{command}");
        assert_eq!(wire.ids(), [(before, before)], "{command}");
        wire.power_cycle();
        assert_eq!(wire.ids(), [(before, before)], "{command}");
        let _ = fs::remove_file(table.with_file_name("back.toml.unfinished"));
    }
}

#[test]
fn a_stored_node_id_that_a_board_does_not_use_is_taken_back() {
    let table = file("unused.toml", entry(7, 0));
    let set = "set-id 7 --store --reset".to_owned();
    for command in [set, format!("assign --table {}", table.display())] {
        let wire = Wire::new(RATE, &[3]);
        wire.bus().slaves[0].defect = Some(Defect::IgnoresResets);
        let outcome = wire.lss(&command);
        assert_eq!(outcome.code, 1, "{command}");
        let words =
            format!("board {}: it accepted node-ID 7, but has 3 after a reset", address_text(0));
        assert!(outcome.error.starts_with(&words), "{command}: {}", outcome.error);
        wire.power_cycle();
        assert_eq!(wire.ids(), [(Some(3), Some(3))], "{command}");
    }
}

#[test]
fn a_board_that_loses_its_node_id_again_is_named() {
    let wire = Wire::new(RATE, &[0xFF; 3]);
    wire.bus().slaves[0].defect = Some(Defect::LosesItsNodeId);
    let outcome = wire.lss("assign");
    let words = format!("board {} has lost node-ID 1 again", address_text(0));
    assert_eq!((outcome.code, &*outcome.error), (1, &*words));
    assert_stored(&wire, &[1, 2]);
}

#[test]
fn a_node_id_that_cannot_be_taken_back_is_told() {
    let wire = with_pending(&[0xFF]);
    wire.bus().slaves[0].defect = Some(Defect::Refuses(&[0x11, 0xFF]));
    let outcome = wire.lss("assign");
    assert_eq!(outcome.code, 1);
    let words =
        "a board may have a node-ID that is not stored: configure node-ID: not configured (FF) is";
    assert!(outcome.error.starts_with(words), "{}", outcome.error);
    assert!(outcome.error.ends_with(": switch the power of all boards off and on"));
    wire.assert_waiting();
    wire.power_cycle();
    assert_eq!(wire.lss("assign").code, 0);
    assert_stored(&wire, &[0]);
}

#[test]
fn a_board_that_is_gone_before_its_node_id_is_taken_back_is_told() {
    let wire = with_pending(&[0xFF]);
    wire.fail_at(At::Write(0), Fault::BoardGone(0));
    let outcome = wire.lss("assign");
    assert_eq!(outcome.code, 1);
    let words = "a board may have a node-ID that is not stored: ";
    assert!(outcome.error.starts_with(words), "{}", outcome.error);
}

#[test]
fn set_id_with_store_reads_back_what_is_stored() {
    for (before, reset) in [(None, ""), (Some(3), "--reset")] {
        let wire = Wire::new(RATE, &[before.unwrap_or(0xFF)]);
        wire.bus().slaves[0].defect = Some(Defect::Forgets);
        let outcome = wire.lss(&format!("set-id 7 --store {reset}"));
        assert_eq!(outcome.code, 1, "{}", outcome.text);
        assert!(outcome.error.contains("it stored node-ID 7, but has "), "{}", outcome.error);
        assert_eq!(wire.ids(), [(before, before)]);
    }
}

#[test]
fn another_board_at_the_node_id_after_the_reset_is_told() {
    // Board 1 has the node-ID, and comes when board 0 is reset.
    let wire = Wire::new(RATE, &[0xFF, 1]);
    wire.record().may_collide = true;
    wire.pull_out(1);
    wire.bus().slaves[0].defect = Some(Defect::IsReplacedAtReset(1));
    let outcome = wire.lss("assign");
    assert_eq!(outcome.code, 1, "{}", outcome.text);
    let words = format!(
        "board {}: node 1 is another board, with the serial number 00001001",
        address_text(0)
    );
    assert!(outcome.error.starts_with(&words), "{}", outcome.error);
}

#[test]
fn a_boot_up_message_may_be_lost_twice() {
    let wire = Wire::new(RATE, &[0xFF]);
    // That after LSS configuration state is the first.
    wire.bus().slaves[0].defect = Some(Defect::LosesBootUps(3));
    let outcome = wire.lss("assign");
    assert_eq!((outcome.code, outcome.text.matches(VERIFIED).count()), (0, 1), "{}", outcome.text);
    wire.bus().slaves[0].defect = Some(Defect::LosesBootUps(2));
    let outcome = wire.lss("set-id 9 --store --reset");
    assert_eq!((outcome.code, wire.ids()), (0, vec![(Some(9), Some(9))]));
}

#[test]
fn boards_of_a_table_that_are_missing_do_not_cost_minutes() {
    let table = new_file("all-missing.toml");
    let text: String = (1..=127).map(|id| entry(id, id as usize)).collect();
    // Nobody is there, a node, a blank board.
    for (boards, seconds) in [(&[][..], 10), (&[9], 40), (&[0xFF], 40)] {
        for command in ["assign --table", "apply"] {
            fs::write(&table, &text).expect("it can be written");
            let wire = Wire::new(RATE, boards);
            let outcome = wire.lss(&format!("{command} {}", table.display()));
            let code = if boards.is_empty() && command == "apply" { 3 } else { 1 };
            assert_eq!(outcome.code, code, "{command} {boards:?}");
            assert!(wire.seconds() < seconds, "{command} {boards:?}: {} s", wire.seconds());
        }
    }
}

#[test]
fn a_board_among_many_missing_ones_is_found() {
    let table = new_file("one-of-many.toml");
    let text: String = (1..=127).map(|id| entry(id, id as usize - 1)).collect();
    for command in ["assign --table", "apply"] {
        fs::write(&table, &text).expect("it can be written");
        let mut ids = [0xFF; 41];
        // It has another node-ID, and tells nothing by SDO.
        ids[40] = 99;
        let wire = Wire::new(RATE, &ids);
        (0..40).filter(|board| *board != 30).for_each(|board| wire.pull_out(board));
        wire.nmt(40, "02 63");
        let outcome = wire.lss(&format!("{command} {}", table.display()));
        assert_eq!(outcome.code, 1, "{command}");
        assert_eq!((wire.ids()[30], wire.ids()[40]), ((Some(31), Some(31)), (Some(41), Some(41))));
        assert!(wire.seconds() < 40, "{command}: {} s", wire.seconds());
    }
}

#[test]
fn a_new_board_is_moved_when_another_one_came_with_its_node_id() {
    let table = new_file("moved.toml");
    // The table gives it the node-ID that the other one has.
    let told = "another board has node-ID 1, which the table gives to";
    for (options, code, error) in
        [(String::new(), 0, ""), (format!("--table {}", table.display()), 1, told)]
    {
        let wire = Wire::new(RATE, &[0xFF, 1]);
        wire.record().may_collide = true;
        wire.pull_out(1);
        wire.bus().slaves[0].defect = Some(Defect::IsJoinedAtReset(1));
        let outcome = wire.lss(&format!("assign {options}"));
        assert_eq!(outcome.code, code, "{}", outcome.error);
        assert!(outcome.error.starts_with(error), "{}", outcome.error);
        assert!(outcome.text.contains("another board came with node-ID 1\n"), "{}", outcome.text);
        wire.record().may_collide = false;
        wire.power_cycle();
        assert_eq!(wire.ids(), [2, 1].map(|id| (Some(id), Some(id))));
    }
}

#[test]
fn boards_that_share_a_node_id_are_named() {
    let wire = Wire::new(RATE, &[5, 5, 0xFF]);
    wire.record().may_collide = true;
    let outcome = wire.lss("assign");
    assert_eq!(outcome.code, 1);
    let boards = [0, 1].map(address_text).join(", ");
    let words = format!("2 boards have node-ID 5, with the LSS addresses {boards}: give all but");
    assert!(outcome.error.starts_with(&words), "{}", outcome.error);
    assert_eq!(wire.ids()[2], (Some(1), Some(1)));
}

#[test]
fn the_node_id_of_a_heartbeat_is_not_given_though_nobody_answers() {
    let wire = Wire::with_heartbeat(RATE, &[1, 0xFF], 100);
    // It is stopped, and does not answer to SDO.
    wire.nmt(0, "02 01");
    assert_eq!(wire.lss("assign").code, 0);
    assert_eq!(wire.ids(), [1, 2].map(|id| (Some(id), Some(id))));
}

#[test]
fn a_node_whose_first_answer_is_lost_keeps_its_node_id_alone() {
    // Others answer.
    let wire = Wire::new(RATE, &[1, 0xFF, 5, 6]);
    wire.bus().slaves[0].defect = Some(Defect::LosesAnswers(1));
    assert_eq!(wire.lss("assign").code, 0);
    assert_eq!(wire.ids(), [1, 2, 5, 6].map(|id| (Some(id), Some(id))));
}

#[test]
fn a_board_with_the_serial_number_of_another_product_is_not_the_one() {
    let path = new_file("serial-number.toml");
    for (part, other) in [(":4C535334:", ":4C535335:"), (":00010000:", ":00010001:")] {
        fs::write(&path, entry(5, 0).replace(part, other)).expect("it can be written");
        let wire = Wire::new(RATE, &[5]);
        let outcome = wire.lss(&format!("assign --table {}", path.display()));
        assert_eq!(outcome.code, 1, "{}", outcome.text);
        assert!(outcome.error.starts_with("node 5 of the table is missing"), "{}", outcome.error);
    }
}

/// Two boards, of which the second has been given the node-ID of the first, and what was told.
fn shared(defect: Option<Defect>) -> (Wire, String) {
    let wire = Wire::new(RATE, &[1, 0xFF]);
    wire.record().may_collide = true;
    let mut bus = wire.bus();
    // The other one answers first.
    bus.slaves[1].habits.other_us = 200..201;
    // Nobody knows of it when node-ID 1 is given.
    bus.slaves[0].defect = Some(Defect::LosesAnswers(2));
    bus.slaves[1].defect = defect;
    drop(bus);
    let outcome = wire.lss("assign");
    let [known, new] = [0, 1].map(address_text);
    let start = format!("board {new}: board {known} has node-ID 1, too: it ");
    assert_eq!(outcome.code, 1);
    let fate = outcome.error.strip_prefix(&start).unwrap_or_else(|| panic!("{}", outcome.error));
    let fate = fate.lines().next().unwrap_or_default().to_owned();
    (wire, fate)
}

#[test]
fn a_node_id_that_turns_out_to_be_shared_is_taken_back_and_both_boards_are_named() {
    let (wire, fate) = shared(None);
    assert_eq!(fate, "was taken back from this one, which has stored that");
    wire.record().may_collide = false;
    assert_eq!(wire.ids(), [(Some(1), Some(1)), (None, None)]);
    wire.power_cycle();
    assert_eq!(wire.lss("assign").code, 0);
    assert_eq!(wire.ids(), [1, 2].map(|id| (Some(id), Some(id))));
}

#[test]
fn what_a_board_that_shares_a_node_id_has_not_stored_is_told() {
    for (defect, words, ids) in [
        (
            Defect::StoresOnce(&Defect::Refuses(&[0x17])),
            "was taken back from this one until its next start, since that is not stored: store configuration is refused",
            (None, Some(1)),
        ),
        (
            Defect::StoresOnce(&Defect::Forgets),
            "cannot be taken back from this one: it accepted node-ID none, but has 1 after a reset",
            (Some(1), Some(1)),
        ),
        (
            Defect::Refuses(&[0x11, 0xFF]),
            "cannot be taken back from this one: it accepted node-ID none, but has 1 after a reset",
            (Some(1), Some(1)),
        ),
    ] {
        let (wire, fate) = shared(Some(defect));
        assert!(fate.starts_with(words), "{defect:?}: {fate}");
        assert_eq!(wire.ids()[1], ids, "{defect:?}");
    }
}

#[test]
fn a_node_without_sdo_is_known_by_its_heartbeat() {
    for boards in [&[5][..], &[5, 7]] {
        let wire = Wire::with_heartbeat(RATE, boards, 1_000);
        wire.bus().slaves[0].defect = Some(Defect::LosesAnswers(usize::MAX));
        let listed = wire.lss("list");
        assert_eq!((listed.code, listed.text.lines().count()), (0, boards.len() + 1));
        let row = listed.text.lines().nth(1).expect("a row");
        let cells: Vec<&str> = row.split_whitespace().collect();
        assert_eq!(cells, ["5", "-", "-", "-", "pre-operational", "125"]);
        let switched = wire.lss("set-rate 250");
        assert_eq!(switched.code, 1);
        let words = "node 5 does not tell its LSS address: it cannot be switched with the others";
        assert!(switched.error.starts_with(words), "{}", switched.error);
    }
}

#[test]
fn a_node_that_sends_process_data_alone_is_there() {
    for cob_id in [0x181, 0x281, 0x381, 0x481] {
        let wire = Wire::new(RATE, &[0xFF]);
        let pdo = Frame::new(cob_id, &[]).expect("a frame");
        let mut bus = wire.bus();
        let begin = bus.now();
        (0..100).for_each(|at| bus.send_from_another_master(begin + 100_000 * at, pdo));
        drop(bus);
        let listed = wire.lss("list");
        assert_eq!((listed.code, listed.text.lines().count()), (0, 3), "{cob_id:X}");
        assert!(listed.text.lines().nth(1).is_some_and(|row| row.starts_with("1  ")));
        // Its node-ID is not given to another board.
        assert_eq!(wire.lss("assign").code, 0);
        assert_eq!(wire.ids(), [(Some(2), Some(2))], "{cob_id:X}");
    }
}

#[test]
fn a_node_without_sdo_tells_its_lss_address_to_lss_when_it_is_alone() {
    for (boards, words) in [
        (&[5][..], ""),
        (&[5, 7], "node 5 can be asked for its LSS address only alone on the bus"),
        (&[5, 0xFF], "node 5 can be asked for its LSS address only alone on the bus"),
    ] {
        let wire = Wire::with_heartbeat(RATE, boards, 1_000);
        wire.bus().slaves[0].defect = Some(Defect::LosesAnswers(usize::MAX));
        let listed = wire.lss("list --ask");
        assert_eq!(&*listed.error, words);
        assert_eq!(listed.text.contains(&address_text(0)), words.is_empty(), "{}", listed.text);
        wire.assert_waiting();
    }
}

#[test]
fn a_board_without_fastscan_is_found_though_two_answers_are_lost() {
    let wire = Wire::new(RATE, &[0xFF, 0xFF]);
    let mut bus = wire.bus();
    bus.slaves[1].habits.without = &[0x51];
    bus.slaves[1].defect = Some(Defect::LosesAnswers(2));
    drop(bus);
    let outcome = wire.lss("assign");
    assert_eq!((outcome.code, &*outcome.error), (0, ""));
    assert_eq!(wire.ids(), [1, 2].map(|id| (Some(id), Some(id))));
}

#[test]
fn a_board_that_spoils_fastscan_is_named_and_all_others_are_finished() {
    for defect in [Defect::IgnoresItsSelection, Defect::TellsAnotherSerialNumber] {
        for bad in [0, 1, 2] {
            let wire = Wire::new(RATE, &[0xFF; 3]);
            wire.bus().slaves[bad].defect = Some(defect);
            let listed = wire.lss("list");
            assert_eq!(listed.code, 1, "{defect:?} {bad}");
            let others: Vec<usize> = (0..3).filter(|board| *board != bad).collect();
            for board in &others {
                assert!(listed.text.contains(&address_text(*board)), "{defect:?} {bad}");
            }
            assert!(listed.error.contains(&address_text(bad)), "{defect:?}: {}", listed.error);
            let outcome = wire.lss("assign");
            assert_stored(&wire, &others);
            // Fastscan itself brings the one that ignores its selection to LSS configuration state.
            let is_lost = defect == Defect::TellsAnotherSerialNumber;
            assert_eq!(outcome.code, u8::from(is_lost), "{defect:?} {bad}");
            assert_eq!(outcome.error.contains(&address_text(bad)), is_lost, "{}", outcome.error);
            assert_eq!(wire.ids()[bad].0.is_none(), is_lost, "{defect:?} {bad}");
        }
    }
}

#[test]
fn a_device_that_says_yes_to_each_question_is_named_and_the_boards_of_the_table_are_finished() {
    let table = file("yes.toml", entry(7, 0));
    let wire = Wire::new(RATE, &[0xFF, 0xFF, 5]);
    wire.bus().slaves[1].habits.claims_all = true;
    let outcome = wire.lss(&format!("assign --table {}", table.display()));
    assert_eq!((outcome.code, wire.ids()[0]), (1, (Some(7), Some(7))), "{}", outcome.error);
    assert!(outcome.error.contains("a device answers each question"), "{}", outcome.error);
    let listed = wire.lss("list");
    assert_eq!((listed.code, listed.text.lines().count()), (1, 4), "{}", listed.text);
    assert!(listed.error.contains("a device answers each question"), "{}", listed.error);
}
