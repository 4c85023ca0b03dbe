//! `lss apply`.

mod files;
mod interrupted;

use std::{
    fs,
    path::{Path, PathBuf},
};

use canopen_node::BitRate;
use testkit::{cargo, image::Firmware, slave_bus::Defect};

use crate::{
    assign::entry,
    emulated::{self, Boards},
    in_process::{Wire, address_text},
};
use interrupted::{assert_exchanged, exchange};

const RATE: BitRate = BitRate::Kbit125;
/// The data sheet of the boards.
fn eds() -> String {
    cargo::workspace().join("eds/io.eds").display().to_string()
}

/// A folder for one test, without what an earlier run has left.
fn folder(name: &str) -> PathBuf {
    let path = cargo::scratch("apply").join(name);
    let _ = fs::remove_dir_all(&path);
    fs::create_dir_all(&path).expect("it can be made");
    path
}

/// A file with this text in a folder for one test.
fn file(test: &str, text: &str) -> PathBuf {
    let path = folder(test).join("network.toml");
    fs::write(&path, text).expect("it can be written");
    path
}

fn node(id: u8, board: usize) -> String {
    format!("[[node]]\nid = {id}\naddress = \"{}\"\n", address_text(board))
}

fn node_with(id: u8, board: usize, values: &str) -> String {
    node_of(Path::new(&eds()), id, board, values)
}

fn node_of(sheet: &Path, id: u8, board: usize, values: &str) -> String {
    let sheet = sheet.display();
    format!("{}eds = \"{sheet}\"\n[node.values]\n{values}\n", node(id, board))
}

/// A data sheet with some of the objects, which is read faster.
fn short_sheet(test: &str, objects: &[&str]) -> PathBuf {
    let text = fs::read_to_string(eds()).expect("the data sheet");
    let is_kept = |section: &&str| {
        let is_head = !section.starts_with(|first: char| first.is_ascii_digit());
        is_head || objects.iter().any(|object| section.starts_with(object))
    };
    let sections = text.split("\n[").filter(is_kept);
    let path = folder(&format!("{test}-sheet")).join("short.eds");
    fs::write(&path, sections.collect::<Vec<_>>().join("\n[")).expect("it can be written");
    path
}

/// Values of each kind, with a PDO.
const VALUES: &str = "\"2100\" = 4\n\"2101:1\" = 1.25\n\"Calibration of the temperature.Inspector\" = \"Ada Lovelace\"\n\
    \"Producer heartbeat time\" = 500\n\"1014\" = \"$NODEID+0x90\"\n\"2101sub2\" = -5\n\
    \"1A02:0\" = 1\n\"1A02:1\" = 0x64010110\n\"1802:1\" = \"$NODEID+0x40000380\"\n\"1802:2\" = 1\n";

/// Asserts that another run finds nothing to do, and writes nothing.
#[track_caller]
fn assert_done(wire: &Wire, file: &Path) {
    for options in ["", "--plan", "--full"] {
        let (outcome, writes) = wire.apply(file, options);
        assert_eq!((outcome.code, writes), (0, 0), "{options}: {}{}", outcome.text, outcome.error);
        assert!(outcome.text.contains("plan: 0 of "), "{}", outcome.text);
    }
    wire.assert_waiting();
}

#[test]
fn a_network_is_brought_to_the_table_and_a_second_run_writes_nothing() {
    let wire = Wire::new(RATE, &[0xFF, 9, 12]);
    let text = node_with(5, 0, VALUES) + &node(6, 1) + &node(12, 2);
    let file = file("first", &text);
    let (plan, writes) = wire.apply(&file, "--plan");
    assert_eq!((plan.code, writes), (1, 0));
    let (outcome, writes) = wire.apply(&file, "");
    assert_eq!(outcome.code, 0);
    assert!(writes > 20, "{writes}");
    wire.power_cycle();
    let ids = [5, 6, 12].map(|id| (Some(id), Some(id)));
    assert_eq!(wire.ids(), ids);
    assert_eq!(wire.value(0, 0x2100, 0), [4]);
    assert_eq!(wire.value(0, 0x2101, 1), 1.25_f32.to_le_bytes());
    assert_eq!(wire.value(0, 0x2101, 2), (-5_i64).to_le_bytes());
    assert_eq!(wire.value(0, 0x2101, 3), b"Ada Lovelace");
    assert_eq!(wire.value(0, 0x1014, 0), [0x95, 0, 0, 0]);
    assert_eq!(wire.value(0, 0x1A02, 1), [0x10, 0x01, 0x01, 0x64]);
    assert_eq!(wire.value(0, 0x1802, 1), [0x85, 0x03, 0, 0x40]);
    assert_done(&wire, &file);
}

#[test]
fn a_plan_says_what_is_there_and_what_it_will_be_and_changes_nothing() {
    let wire = Wire::new(RATE, &[0xFF, 5]);
    wire.set(1, 0x2100, 0, &[7]);
    let text = node(6, 0) + "name = \"pump\"\n" + &node_with(5, 1, "\"2100\" = 4\n2101sub1 = 1");
    let file = file("plan", &text);
    let (outcome, writes) = wire.apply(&file, "--check");
    assert_eq!((outcome.code, writes), (1, 0));
    let expected = format!(
        "  bit rate: 125 kbit/s\n\
         ~ node 6 \"pump\"  {}\n    ~ node-ID: none -> 6\n\
         ~ node 5  {}\n    ~ 2100 Filter constant of the temperature: 7 -> 4\n\
         plan: 2 of 2 boards change, 0 missing; 1 node-ID, 1 value\n",
        address_text(0),
        address_text(1)
    );
    assert_eq!(outcome.text, expected);
    assert!(outcome.error.starts_with("2 of 2 boards differ from the files"), "{}", outcome.error);
    assert_eq!(wire.ids()[0], (None, None));
    let (outcome, writes) = wire.apply(&file, "--plan --json");
    assert_eq!((outcome.code, writes), (1, 0));
    let json: serde_json::Value = serde_json::from_str(&outcome.text).expect("JSON");
    assert_eq!(json["differs"], true);
    assert_eq!(json["nodes"][0]["node_id"]["found"], serde_json::Value::Null);
    assert_eq!(json["nodes"][0]["node_id"]["wanted"], 6);
    let value = &json["nodes"][1]["values"][0];
    assert_eq!(
        (&value["index"], &value["found"], &value["wanted"]),
        (&0x2100.into(), &"7".into(), &"4".into())
    );
}

#[test]
fn a_plan_compares_values_before_a_board_gets_another_node_id() {
    let wire = Wire::new(RATE, &[5]);
    wire.set(0, 0x2101, 3, b"Ada");
    let values =
        "\"2101:3\" = \"Ade\"\n\"1014\" = \"$NODEID+0x80\"\n\"1800:1\" = \"$NODEID+0x40000200\"";
    let (outcome, writes) = wire.apply(&file("follows", &node_with(7, 0, values)), "--plan");
    assert_eq!((outcome.code, writes), (1, 0));
    let expected = format!(
        "~ node 7  {}\n    ~ node-ID: 5 -> 7\n\
         \x20   ~ 1800:1 TPDO communication parameter 1.COB-ID used by TPDO: 0x40000187 -> 0x40000207\n\
         \x20   ~ 2101:3 Calibration of the temperature.Inspector: \"Ada\" -> \"Ade\"\nplan: ",
        address_text(0)
    );
    assert!(outcome.text.contains(&expected), "{}", outcome.text);
}

#[test]
fn boards_exchange_their_node_ids_and_never_share_one() {
    // 5 and 6 change places, and so do 7, 8 and 9 in a circle; 10 follows into a free place.
    let found = [5, 6, 7, 8, 9, 10, 11];
    let wanted = [6, 5, 8, 9, 7, 11, 12];
    let table: String = (0..7).map(|board| node(wanted[board], board)).collect();
    for defect in [None, Some(Defect::Refuses(&[0x11, 0xFF]))] {
        let wire = Wire::new(RATE, &found);
        wire.bus().slaves.iter_mut().for_each(|board| board.defect = defect);
        let file = file("exchange", &table);
        assert_eq!(wire.apply(&file, "").0.code, 0);
        assert_eq!(wire.ids(), wanted.map(|id| (Some(id), Some(id))));
        // One board of each circle gives its node-ID up.
        let parked = |frame: &&canopen_node::Frame| frame.data().starts_with(&[0x11, 0xFF]);
        let count = wire.record().sent.iter().filter(parked).count();
        assert_eq!(count, 2, "{defect:?}");
        assert_done(&wire, &file);
    }
}

#[test]
fn assign_exchanges_node_ids_as_apply_does() {
    for command in ["assign --table", "apply"] {
        let wire = Wire::new(RATE, &[5, 6, 9]);
        let file = file("exchange-by", &(node(6, 0) + &node(5, 1) + &node(9, 2)));
        let outcome = wire.lss(&format!("{command} {}", file.display()));
        assert_eq!(outcome.code, 0, "{command}: {}", outcome.error);
        assert_eq!(wire.ids(), [6, 5, 9].map(|id| (Some(id), Some(id))), "{command}");
        // Nothing is told of the board that gives its node-ID up meanwhile.
        assert!(!outcome.text.contains("no boot-up message"), "{command}: {}", outcome.text);
    }
}

#[test]
fn the_node_id_of_a_stopped_node_is_given_to_nobody() {
    for command in ["assign --table", "apply"] {
        let wire = Wire::with_heartbeat(RATE, &[1, 0xFF], 100);
        // It does not answer to SDO.
        wire.nmt(0, "02 01");
        let file = file("heard", &node(1, 1));
        let outcome = wire.lss(&format!("{command} {}", file.display()));
        assert_eq!(outcome.code, 1, "{command}");
        let words = "another board has node-ID 1";
        assert!(outcome.error.contains(words), "{command}: {}", outcome.error);
        assert_eq!(wire.ids(), [(Some(1), Some(1)), (None, None)], "{command}");
    }
}

#[test]
fn a_node_id_that_a_board_leaves_stays_that_of_another_one() {
    for command in ["assign --table", "apply"] {
        let wire = Wire::new(RATE, &[5, 5, 0xFF]);
        wire.record().may_collide = true;
        // Only the other one answers to SDO.
        wire.nmt(0, "02 05");
        let file = file("leaves", &(node(6, 0) + &node(5, 2)));
        let outcome = wire.lss(&format!("{command} {}", file.display()));
        assert_eq!(outcome.code, 1, "{command}");
        let words = "another board has node-ID 5";
        assert!(outcome.error.contains(words), "{command}: {}", outcome.error);
        wire.record().may_collide = false;
        wire.power_cycle();
        let ids = [Some(6), Some(5), None];
        assert_eq!(wire.ids(), ids.map(|id| (id, id)), "{command}");
    }
}

#[test]
fn boards_that_share_a_node_id_get_their_own() {
    let wire = Wire::new(RATE, &[5, 5, 5]);
    wire.record().may_collide = true;
    let values = "\"2100\" = 6";
    let file = file(
        "shared",
        &(node_with(5, 0, values) + &node_with(6, 1, values) + &node_with(7, 2, values)),
    );
    assert_eq!(wire.apply(&file, "").0.code, 0);
    assert_eq!(wire.ids(), [5, 6, 7].map(|id| (Some(id), Some(id))));
    assert!((0..3).all(|board| wire.value(board, 0x2100, 0) == [6]));
    wire.record().may_collide = false;
    assert_done(&wire, &file);
}

#[test]
fn values_wait_while_another_board_has_the_same_node_id() {
    let wire = Wire::new(RATE, &[5, 5, 6]);
    wire.record().may_collide = true;
    let (outcome, _) =
        wire.apply(&file("waits", &(node_with(5, 0, "\"2100\" = 6") + &node(6, 1))), "");
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.contains("node 6: another board has node-ID 6"), "{}", outcome.error);
    assert!((0..2).all(|board| wire.value(board, 0x2100, 0) != [6]));
}

#[test]
fn a_node_that_does_not_tell_its_serial_number_is_found_by_lss() {
    let wire = Wire::new(RATE, &[6, 7]);
    for board in &mut wire.bus().slaves {
        board.defect = Some(Defect::HidesItsSerialNumber);
    }
    let (outcome, _) = wire.apply(&file("hidden", &node(6, 0)), "");
    assert_eq!(outcome.code, 0, "{}", outcome.error);
    // The other one may be any board.
    assert_eq!(outcome.text.matches("\n? ").count(), 1, "{}", outcome.text);
    assert!(outcome.text.contains("\n? -  node-ID 7, not in the files"), "{}", outcome.text);
}

#[test]
fn missing_and_unknown_boards_are_named_and_the_others_are_done() {
    let wire = Wire::new(RATE, &[0xFF, 9, 0xFF, 7]);
    // Board 8 is not there, 1 and 2 are not in the table, and 3 is to have the node-ID of 1.
    let file = file("missing", &(node(5, 0) + &node(6, 8) + &node(9, 3)));
    for _ in 0..2 {
        let (outcome, _) = wire.apply(&file, "");
        assert_eq!(outcome.code, 1);
        for (id, board) in [("9", 1), ("none", 2)] {
            let line = format!(
                "? {}  node-ID {id}, not in the files: it stays as it is\n",
                address_text(board)
            );
            assert!(outcome.text.contains(&line), "{}", outcome.text);
        }
        let missing =
            format!("node 6 is missing: {}. Is it on the bus, and has it power?", address_text(8));
        assert!(outcome.error.contains(&missing), "{}", outcome.error);
        assert!(outcome.error.contains("node 9: another board has node-ID 9. Give it another one"));
        let ids = [Some(5), Some(9), None, Some(7)];
        assert_eq!(wire.ids(), ids.map(|id| (id, id)));
    }
    wire.assert_waiting();
}

#[test]
fn a_board_that_is_stopped_is_found_and_its_values_wait() {
    let wire = Wire::new(RATE, &[5]);
    wire.nmt(0, "02 05");
    let (outcome, writes) = wire.apply(&file("stopped", &node_with(5, 0, "\"2100\" = 1")), "");
    assert_eq!((outcome.code, writes), (1, 0));
    assert!(
        outcome.error.contains("cannot be read: no answer. Is the node stopped (NMT)?"),
        "{}",
        outcome.error
    );
}

#[test]
fn a_value_that_the_board_does_not_store_is_told_at_each_run() {
    let wire = Wire::new(RATE, &[5]);
    let file = file("volatile", &node_with(5, 0, "\"6200:1\" = 3\n\"2100\" = 1"));
    for _ in 0..2 {
        let (outcome, writes) = wire.apply(&file, "");
        assert_eq!(outcome.code, 1);
        assert!(writes > 0);
        let why = "6200:1 Write output 8-bit.LEDs is 0 after a reset, and not 3: the board does not store it";
        assert!(outcome.error.contains(why), "{}", outcome.error);
    }
    assert_eq!(wire.value(0, 0x2100, 0), [1]);
}

#[test]
fn what_a_board_refuses_is_told_with_its_reason() {
    let wire = Wire::new(RATE, &[5]);
    // The data sheet has no limit for these.
    let (outcome, _) = wire.apply(&file("refused", &node_with(5, 0, "\"2101:1\" = 3.5")), "");
    assert_eq!(outcome.code, 1);
    let why = "node 5: left out: 2101:1 Calibration of the temperature.Gain cannot be 3.5: the value is too high (abort \
         06090031)";
    assert!(outcome.error.contains(why), "{}", outcome.error);
}

#[test]
fn the_network_comes_to_the_bit_rate_of_the_table_and_new_boards_with_it() {
    let file = file("rate", &exchange("rate", 500));
    let wire = Wire::with_heartbeat(RATE, &[5, 6, 0xFF], 1000);
    let (plan, writes) = wire.apply(&file, "--plan");
    assert_eq!((plan.code, writes), (1, 0));
    assert!(
        plan.text.starts_with("~ bit rate: 125 -> 500 kbit/s, of all boards on the bus\n"),
        "{}",
        plan.text
    );
    assert_eq!(wire.apply(&file, "").0.code, 0);
    wire.power_cycle();
    assert_exchanged(&wire, "500 kbit/s");
    let rates: Vec<BitRate> = wire.bit_rates();
    assert_eq!(rates, [BitRate::Kbit500; 3]);
    assert_done(&wire, &file);
    // A network without a heartbeat is asked at the bit rate of the table alone.
    let quiet = Wire::new(BitRate::Kbit125, &[5, 6, 0xFF]);
    let (outcome, writes) = quiet.apply(&file, "");
    assert_eq!((outcome.code, writes), (3, 0));
    assert!(
        outcome.error.ends_with("If the boards are at 125 kbit/s: --bit-rate 125"),
        "{}",
        outcome.error
    );
    assert_eq!(quiet.apply(&file, "--bit-rate 125").0.code, 0);
    assert_exchanged(&quiet, "500 kbit/s, quiet");
    // The board that was new sends a heartbeat.
    quiet.set(2, 0x1017, 0, &[0, 0]);
    assert_eq!(quiet.apply(&file, "").0.code, 0);
    assert_done(&quiet, &file);
}

#[test]
fn a_silent_network_at_the_bit_rate_of_the_table_is_configured() {
    let file = file("rate-silent", &exchange("rate-silent", 500));
    let wire = Wire::new(BitRate::Kbit500, &[5, 6, 7]);
    let (outcome, _) = wire.apply(&file, "");
    assert_eq!(outcome.code, 0, "{}", outcome.error);
    assert_exchanged(&wire, "500 kbit/s, silent");
}

#[test]
fn the_bit_rate_stays_while_a_board_is_missing() {
    let wire = Wire::with_heartbeat(RATE, &[9], 1000);
    let file = file("rate-missing", &format!("bit_rate = 500\n{}{}", node(5, 0), node(6, 8)));
    let (outcome, _) = wire.apply(&file, "");
    assert_eq!(outcome.code, 1);
    let why =
        "the bit rate stays 125 kbit/s, since a board is missing: it would be lost at 500 kbit/s";
    assert!(outcome.error.contains(why), "{}", outcome.error);
    assert_eq!(wire.ids(), [(Some(5), Some(5))]);
    assert_eq!(wire.bus().slaves[0].rig.bit_rate(), RATE);
}

#[test]
fn a_board_that_cannot_store_values_has_them_until_its_reset() {
    let sheet = short_sheet("volatile-sheet", &["1017", "1020", "2100"]);
    let file = file("cannot-store", &node_of(&sheet, 5, 0, "\"2100\" = 1"));
    let wire = Wire::new(RATE, &[0xFF]);
    let (outcome, _) = wire.apply(&file, "");
    assert_eq!(outcome.code, 0);
    let words = "node-ID stored, 1 value written, until the next reset: it cannot store them";
    assert!(outcome.text.contains(words), "{}", outcome.text);
    assert_done(&wire, &file);
    wire.power_cycle();
    assert_eq!(wire.apply(&file, "--plan").0.code, 1);
}

#[test]
fn a_stamp_of_the_files_is_written_last_and_proves_nothing() {
    let wire = Wire::new(RATE, &[5]);
    let stamp = "\"1020:1\" = 15645\n\"1020:2\" = 7\n";
    let before = file("stamp", &node_with(5, 0, &format!("\"2100\" = 1\n{stamp}")));
    assert_eq!(wire.apply(&before, "").0.code, 0);
    wire.power_cycle();
    assert_eq!(wire.value(0, 0x1020, 1), 15645_u32.to_le_bytes());
    assert_done(&wire, &before);
    // The same stamp for other values: somebody has not counted it up.
    let after = file("stamp", &node_with(5, 0, &format!("\"2100\" = 2\n{stamp}")));
    assert_eq!(wire.apply(&after, "").0.code, 0);
    assert_eq!(wire.value(0, 0x2100, 0), [2]);
    assert_done(&wire, &after);
}

#[test]
fn a_node_with_its_stamp_costs_two_reads_of_values() {
    let wire = Wire::new(RATE, &[5]);
    let file = file("stamped", &node_with(5, 0, VALUES));
    assert_eq!(wire.apply(&file, "").0.code, 0);
    let reads = |options: &str| {
        let before = wire.record().sent.len();
        assert_eq!(wire.apply(&file, options).0.code, 0);
        // Without those of the list.
        let is_read = |frame: &&canopen_node::Frame| {
            let [command, low, high, ..] = *frame.data() else { return false };
            let index = u16::from_le_bytes([low, high]);
            frame.cob_id() == 0x605 && command == 0x40 && !matches!(index, 0x1008..=0x1018 | 0x2000)
                || frame.cob_id() == 0x605 && command == 0x40 && index == 0x1014
        };
        wire.record().sent[before..].iter().filter(is_read).count()
    };
    assert_eq!(reads(""), 2);
    // 1017h is not counted.
    assert_eq!(reads("--full"), 2 + 9);
}

#[test]
fn release_images_are_brought_to_the_table_and_keep_it_without_power() {
    let boards = Boards::unattended(Firmware::Io, &[(5, RATE), (6, RATE), (0xFF, RATE)], 1000);
    let values = format!("eds = \"{}\"\n[node.values]\n{VALUES}", eds());
    let text = format!("bit_rate = 500\n{}{values}\n{}{}", entry(6, 0), entry(5, 1), entry(7, 2));
    let file = file("image", &text);
    let apply = |options: &str| boards.lss(&format!("apply {} {options}", file.display()));
    assert_eq!(apply("").code, 0);
    for board in 0..3 {
        boards.rig().power_cycle(board);
        assert_eq!(boards.stored(board), Some(([6, 5, 7][board], 2)), "board {board}");
    }
    let outcome = apply("--full");
    assert_eq!(outcome.code, 0);
    assert!(outcome.text.contains("plan: 0 of 3 boards change"), "{}", outcome.text);
    boards.assert_waiting(BitRate::Kbit500);
}

#[test]
fn a_node_that_was_operational_is_told() {
    let wire = Wire::with_heartbeat(RATE, &[5], 100);
    wire.nmt(0, "01 05");
    let file = file("operational", &node_with(5, 0, "\"2100\" = 1"));
    let (outcome, _) = wire.apply(&file, "");
    assert_eq!(outcome.code, 0);
    let end =
        "  1 value written and stored, verified by a reset, pre-operational since the reset\n";
    assert!(outcome.text.contains(end), "{}", outcome.text);
    assert_done(&wire, &file);
}

#[test]
fn what_must_not_change_in_a_pdo_in_use_changes_while_it_is_off() {
    let wire = Wire::new(RATE, &[5]);
    // The default COB-ID is that of the PDO afterwards.
    let file = file("inhibit", &node_with(5, 0, "\"1800:3\" = 100\n\"1801:2\" = true"));
    assert_eq!(wire.apply(&file, "").0.code, 0);
    assert_eq!(wire.value(0, 0x1800, 3), [100, 0]);
    assert_eq!(wire.value(0, 0x1800, 1), [0x85, 0x01, 0, 0x40]);
    assert_eq!(wire.value(0, 0x1801, 2), [1]);
    assert_done(&wire, &file);
}

#[test]
fn a_cob_id_in_use_is_switched_off_before_it_changes() {
    let sync = Some(Defect::ProducesSync);
    for (index, found, defect, writes) in [
        (0x1014, 0x8000_0085, None, &[0x91][..]),
        (0x1014, 0x85, None, &[0x8000_0085, 0x91]),
        (0x1005, 0x80, None, &[0x91]),
        (0x1005, 0x80, sync, &[0x80, 0x91]),
    ] {
        let wire = Wire::new(RATE, &[5]);
        wire.set(0, index, 0, &u32::to_le_bytes(found));
        wire.bus().slaves[0].defect = defect;
        let file = file("cob-id", &node_with(5, 0, &format!("\"{index:X}\" = 0x91")));
        assert_eq!(wire.apply(&file, "").0.code, 0);
        let [low, high] = u16::to_le_bytes(index);
        let written = |frame: &canopen_node::Frame| match *frame.data() {
            [0x23, a, b, 0, ref value @ ..] if [a, b] == [low, high] => {
                value.first_chunk().copied().map(u32::from_le_bytes)
            }
            _ => None,
        };
        let written: Vec<u32> = wire.record().sent.iter().filter_map(written).collect();
        assert_eq!(written, writes, "{index:X} {found:X}");
    }
}

#[test]
fn the_same_values_have_the_same_stamp_in_each_version() {
    let wire = Wire::new(RATE, &[5]);
    let file = file("stamp", &node_with(5, 0, "\"2100\" = 4"));
    assert_eq!(wire.apply(&file, "").0.code, 0);
    // FNV-1a of index, sub-index, length and value.
    let stamp = [1, 2].map(|sub_index| wire.value(0, 0x1020, sub_index));
    assert_eq!(stamp, [0x95B09B3B_u32, 0x441A86DB].map(|number| number.to_le_bytes().to_vec()));
}

#[test]
fn a_board_of_another_revision_is_told() {
    let wire = Wire::new(RATE, &[5]);
    let text = address_text(0).replace(":00010000:", ":00020000:");
    let (outcome, _) =
        wire.apply(&file("revision", &format!("[[node]]\nid = 5\naddress = \"{text}\"\n")), "");
    let why = format!(
        "node 5 is missing: {text}. But {} answers, with another revision number",
        address_text(0)
    );
    assert!(outcome.error.starts_with(&why), "{}", outcome.error);
}

#[test]
fn a_board_without_fastscan_is_found_by_its_address() {
    let boards = Boards::new(RATE, &[0xFF, 9]);
    boards.unsupported.set(Some(0x51));
    let file = file("no-fastscan", &entry(5, 0));
    let outcome = boards.lss(&format!("apply {} --plan", file.display()));
    // It is not another one.
    assert_eq!(outcome.text.matches("\n? ").count(), 1, "{}", outcome.text);
    let outcome = boards.lss(&format!("apply {}", file.display()));
    assert_eq!(outcome.code, 0);
    assert_eq!(boards.stored(0), Some((5, 4)));
    // The other one is none of the file, and the only such one.
    assert_eq!(outcome.text.matches("\n? ").count(), 1, "{}", outcome.text);
    assert!(outcome.text.contains(&format!("\n? {}  node-ID 9, ", emulated::address_text(1))));
    boards.assert_waiting(RATE);
}

#[test]
fn known_boards_without_a_node_id_are_not_scanned() {
    let wire = Wire::new(RATE, &[0xFF; 6]);
    let table: String = (0..5).map(|board| node(board as u8 + 1, board)).collect();
    let file = file("known", &table);
    let (outcome, _) = wire.apply(&file, "");
    assert_eq!(outcome.code, 0);
    let unknown =
        format!("? {}  node-ID none, not in the files: it stays as it is\n", address_text(5));
    assert!(outcome.text.contains(&unknown), "{}", outcome.text);
    let numbers = |specifier: u8| -> Vec<usize> {
        let is_it = |frame: &canopen_node::Frame| frame.data().first() == Some(&specifier);
        let record = wire.record();
        (0..record.sent.len()).filter(|number| is_it(&record.sent[*number])).collect()
    };
    let (scans, stores) = (numbers(0x51), numbers(0x17));
    // Each bit of the unknown one.
    assert!((100..300).contains(&scans.len()), "{}", scans.len());
    assert!(stores.last() < scans.first(), "{stores:?}");
    assert_done(&wire, &file);
}

#[test]
fn a_text_with_zeros_behind_it_is_the_same_text() {
    let wire = Wire::new(RATE, &[5]);
    wire.bus().slaves[0].defect = Some(Defect::PadsTexts);
    let file = file("padded", &node_with(5, 0, "\"2101:3\" = \"Ada\"\n\"2100\" = 4"));
    let (outcome, _) = wire.apply(&file, "");
    assert_eq!(outcome.code, 0, "{}", outcome.error);
    assert_done(&wire, &file);
}
