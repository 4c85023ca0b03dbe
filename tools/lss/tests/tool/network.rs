//! `lss find` and `lss list`.

use std::fs;

use canopen_node::{BitRate, Frame};
use serde_json::Value;
use testkit::cargo;

use crate::{
    emulated::{Boards, address_text},
    in_process::{self, Wire},
};

const RATE: BitRate = BitRate::Kbit125;

#[test]
fn a_network_at_another_bit_rate_is_found_by_a_question() {
    let boards = Boards::new(BitRate::Kbit250, &[5, 7]);
    let outcome = boards.lss("find --ask --bit-rate 500");
    assert_eq!(outcome.code, 0);
    assert_eq!(
        outcome.text,
        "adapter: emulated boards\n\
         the network runs at 250 kbit/s, and not at 500 kbit/s: use --bit-rate 250\n\
         answers to SDO: node 5, 7\n"
    );
    assert_eq!(boards.lss("list --bit-rate 250").code, 0);
}

#[test]
fn a_network_with_heartbeats_is_found_by_listening_alone() {
    let boards = Boards::new(RATE, &[0xFF, 9]);
    assert_eq!(boards.lss(&format!("set-id 5 --address {}", address_text(0))).code, 0);
    let errors = boards.rig().errors().len();
    let outcome = boards.lss("find --bit-rate 1000");
    assert_eq!(boards.rig().errors().len(), errors, "nobody is disturbed");
    assert!(outcome.text.contains("the network runs at 125 kbit/s, and not at 1000 kbit/s"));
    assert!(outcome.text.contains("heard: heartbeat of node 5: pre-operational ("));
    assert!(!outcome.text.contains("(0)"), "{}", outcome.text);
    assert!(outcome.text.contains("answers to SDO: node 5, 9\n"));
}

#[test]
fn a_network_is_found_without_the_status_of_the_adapter() {
    let wire = Wire::new(BitRate::Kbit250, &[5, 7]);
    wire.record().has_no_status = true;
    let outcome = wire.lss("find --ask");
    let words = "the network runs at 250 kbit/s, and not at 125 kbit/s: use --bit-rate 250\n\
        answers to SDO: node 5, 7\n";
    assert!(outcome.text.ends_with(words), "{}{}", outcome.text, outcome.error);
}

#[test]
fn a_blank_board_is_found() {
    let outcome = Boards::new(RATE, &[0xFF]).lss("find --ask");
    assert!(outcome.text.contains("the network runs at 125 kbit/s\n"), "{}", outcome.text);
    assert!(outcome.text.contains("answers to LSS: at least one board without a node-ID\n"));
}

#[test]
fn blank_boards_do_not_follow_the_questions_to_another_bit_rate() {
    let boards = Boards::new(RATE, &[0xFF, 0xFF]);
    let outcome = boards.lss("find --ask --bit-rate 500");
    assert!(outcome.text.contains("the network runs at 125 kbit/s, and not at 500 kbit/s"));
    assert_eq!(boards.lss("list").text.matches("none").count(), 2);
}

#[test]
fn a_bus_without_a_board_has_its_words() {
    let outcome = Boards::new(RATE, &[]).lss("find --ask");
    assert_eq!(outcome.code, 3);
    assert!(outcome.error.starts_with("nobody acknowledges at any bit rate"), "{}", outcome.error);
}

#[test]
fn all_nodes_are_listed_and_none_is_configured() {
    let boards = Boards::new(RATE, &[5, 0xFF, 0xFF, 7, 0xFF]);
    let outcome = boards.lss("list");
    assert_eq!(outcome.code, 0);
    let lines: Vec<&str> = outcome.text.lines().collect();
    assert_eq!(lines.len(), 6, "{}", outcome.text);
    assert!(lines[0].starts_with("node-ID  LSS address "));
    assert!(lines[1].starts_with(&format!("5        {}  LSS slave ", address_text(0))));
    assert!(lines[2].starts_with(&format!("7        {}  LSS slave ", address_text(3))));
    let mut blank = [1, 2, 4].map(|board| format!("none     {}  -", address_text(board)));
    blank.sort();
    for (line, expected) in lines[3..].iter().zip(&blank) {
        assert!(line.starts_with(expected), "{line}");
    }
    boards.assert_waiting(RATE);
    for board in [1, 2, 4] {
        let inquired = boards.lss(&format!("inquire --address {}", address_text(board)));
        assert!(inquired.text.contains("node-ID          none\n"));
    }
}

#[test]
fn a_list_has_the_bit_rate_in_use_and_the_home_rate_of_a_guest() {
    let boards = Boards::new(RATE, &[5, 7, 0xFF]);
    {
        let mut rig = boards.rig();
        rig.lss("04 01, 13 00 02, 17, 04 00");
        // It starts at the stored rate, and finds that of the others.
        rig.power_cycle(1);
    }
    let text = boards.lss("list").text;
    let lines: Vec<&str> = text.lines().collect();
    assert!(lines[0].ends_with("  NMT state        kbit/s"), "{text}");
    assert!(lines[1].ends_with("  125") && lines[3].ends_with("  125"), "{text}");
    assert!(lines[2].ends_with("  125 (home 500)"), "{text}");
    let outcome = boards.lss("list --json");
    let json: serde_json::Value = serde_json::from_str(&outcome.text).expect("JSON");
    let rates = |key: &str| [0, 1, 2].map(|node| json["nodes"][node][key].clone());
    assert_eq!(rates("bit_rate"), [125, 125, 125]);
    assert_eq!(rates("home_bit_rate"), [125.into(), 500.into(), serde_json::Value::Null]);
}

#[test]
fn a_list_as_json_has_the_bit_rate_and_all_nodes() {
    let outcome = Boards::new(RATE, &[5, 0xFF]).lss("list --json");
    let json: serde_json::Value = serde_json::from_str(&outcome.text).expect("JSON");
    assert_eq!(json["bit_rate"], 125);
    assert_eq!(json["nodes"][0]["node_id"], 5);
    assert_eq!(json["nodes"][0]["name"], "LSS slave");
    assert_eq!(json["nodes"][1]["node_id"], serde_json::Value::Null);
    assert_eq!(json["nodes"][1]["lss_address"], address_text(1));
}

#[test]
fn the_page_has_each_key_of_the_json() {
    let page = fs::read_to_string(cargo::workspace().join("docs/commission.md")).expect("a page");
    let block = page.split("```json").nth(1).and_then(|rest| rest.split("```").next());
    let json = |text: &str| serde_json::from_str::<Value>(text).expect("JSON");
    let keys = |value: &Value| -> Vec<String> {
        value.as_object().into_iter().flatten().map(|(key, _)| key.clone()).collect()
    };
    let wire = Wire::new(RATE, &[5]);
    let (example, list) = (json(block.expect("an example")), json(&wire.lss("list --json").text));
    assert_eq!(keys(&example), keys(&list));
    assert_eq!(keys(&example["nodes"][0]), keys(&list["nodes"][0]));
    let file = cargo::scratch("json.toml");
    let sheet = cargo::workspace().join("eds/io.eds");
    let address = in_process::address_text(0);
    let node = format!("[[node]]\nid = 6\naddress = \"{address}\"\neds = {sheet:?}\n");
    let text = node + "[node.values]\n2100 = 4\n";
    fs::write(&file, text).expect("it can be written");
    let plan = json(&wire.lss(&format!("apply {} --plan --json", file.display())).text);
    let node = &plan["nodes"][0];
    for part in [&plan, node, &node["node_id"], &node["values"][0]] {
        assert!(!keys(part).is_empty());
        for key in keys(part) {
            assert!(page.contains(&format!("`{key}`")), "{key}");
        }
    }
}

#[test]
fn two_boards_with_one_node_id_are_seen_and_can_be_told_apart() {
    let boards = Boards::new(RATE, &[5, 5, 9]);
    let outcome = boards.lss("list");
    assert_eq!(outcome.code, 1);
    for board in 0..2 {
        let row = format!("5 twice  {}", address_text(board));
        assert!(outcome.text.contains(&row), "{}", outcome.text);
    }
    assert!(outcome.error.starts_with("boards share a node-ID"));
    boards.assert_waiting(RATE);
    let set = format!("set-id 6 --reset --address {}", address_text(1));
    assert_eq!(boards.lss(&set).code, 0);
    assert_eq!(boards.lss("list").code, 0);
}

#[test]
fn a_node_whose_answer_comes_twice_is_one() {
    let wire = Wire::new(RATE, &[5, 6]);
    let mut bus = wire.bus();
    let now = bus.now();
    let answer = |id, board| Frame::new(id, &[0x43, 0x18, 0x10, 4, board, 0x10, 0, 0]);
    // The second one comes while node 5 alone is asked again.
    for (ms, frame) in [(100, answer(0x585, 0)), (970, answer(0x586, 1))] {
        bus.send_from_another_master(now + 1_000 * ms, frame.expect("a frame"));
    }
    drop(bus);
    let outcome = wire.lss("list");
    assert_eq!((outcome.code, outcome.text.lines().count()), (0, 3), "{}", outcome.text);
}

#[test]
fn a_list_without_a_node_says_where_to_look() {
    let outcome = Boards::new(RATE, &[]).lss("list");
    assert_eq!(outcome.code, 3);
    assert!(outcome.error.contains("`lss find` looks for the bit rate"));
}

#[test]
fn a_board_is_listed_although_an_answer_of_it_is_lost() {
    let boards = Boards::new(RATE, &[0xFF, 0xFF, 0xFF]);
    boards.answers_until_loss.set(usize::MAX);
    let complete = boards.lss("list");
    let count = usize::MAX - boards.answers_until_loss.get();
    assert!(count > 200, "{count} answers");
    for lost in (1..=count).step_by(17) {
        boards.answers_until_loss.set(lost);
        let outcome = boards.lss("list");
        assert_eq!(boards.answers_until_loss.get(), 0);
        let lines =
            |text: &str| text.lines().map(str::to_owned).collect::<std::collections::BTreeSet<_>>();
        assert_eq!(
            lines(&outcome.text),
            lines(&complete.text),
            "answer {lost} is lost: {}",
            outcome.error
        );
        boards.assert_waiting(RATE);
    }
}

#[test]
fn ctrl_c_in_a_list_leaves_no_board_in_configuration_state() {
    // Its last frames are those of the check of the boards found.
    let boards = Boards::new(RATE, &[0xFF, 0xFF]);
    let count = std::rc::Rc::new(std::cell::Cell::new(0));
    let counted = std::rc::Rc::clone(&count);
    boards.at_each_frame(move |_, _| counted.set(counted.get() + 1));
    assert_eq!(boards.lss("list").code, 0);
    for number in count.get() - 14..count.get() {
        boards.interrupt_at(number);
        let outcome = boards.lss("list");
        assert_eq!(outcome.code, 130, "frame {number} of {}", count.get());
        boards.assert_waiting(RATE);
    }
}

#[test]
fn a_list_bears_heartbeats_between_a_question_and_its_answer() {
    // Rare enough that the master does not expect them.
    for heartbeat_ms in (60..240).step_by(12) {
        let wire = Wire::with_heartbeat(RATE, &[1, 0xFF, 0xFF], heartbeat_ms);
        let outcome = wire.lss("list");
        let expected = (0, 4);
        assert_eq!((outcome.code, outcome.text.lines().count()), expected, "{heartbeat_ms} ms");
        wire.assert_waiting();
    }
}
