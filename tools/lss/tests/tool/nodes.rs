//! `lss start`, `stop`, `reset`, `read` and `write`, and what a person meets on the command line.

use canopen_node::BitRate;
use clap::{CommandFactory, Parser};
use lss::Arguments;
use testkit::{cargo, image::Firmware};

use crate::{
    emulated::Boards,
    in_process::{Wire, address, address_text},
};

const RATE: BitRate = BitRate::Kbit125;

#[test]
fn nodes_are_started_stopped_and_reset_one_by_one_or_together() {
    let wire = Wire::with_heartbeat(RATE, &[5, 6], 500);
    for (command, text) in [
        ("start 5", "node 5  operational\n"),
        ("stop 0x5", "node 5  stopped\n"),
        ("start", "node 5  operational\nnode 6  operational\n"),
        ("stop 6", "node 6  stopped\n"),
        ("reset 6", "node 6  boot-up, pre-operational\n"),
        ("reset", "node 5  boot-up, pre-operational\nnode 6  boot-up, pre-operational\n"),
    ] {
        let outcome = wire.lss(command);
        assert_eq!((outcome.code, &*outcome.text), (0, text), "{command}: {}", outcome.error);
    }
    wire.assert_waiting();
}

#[test]
fn a_state_that_nobody_tells_is_not_claimed() {
    let wire = Wire::new(RATE, &[5]);
    let outcome = wire.lss("start 5");
    let text = "sent; no heartbeat tells the state since then\n";
    assert_eq!((outcome.code, &*outcome.text), (0, text));
    assert_eq!(wire.lss("reset 5").text, "node 5  boot-up\n");
    let outcome = wire.lss("reset 6");
    assert_eq!(outcome.code, 3, "{}", outcome.text);
    // One that is there, and does not obey.
    let wire = Wire::with_heartbeat(RATE, &[5], 500);
    wire.record().loses_nmt = true;
    let outcome = wire.lss("start 5");
    assert_eq!((outcome.code, &*outcome.error), (1, "node 5 has not obeyed"));
}

#[test]
fn values_are_read_and_written_by_type_or_by_the_sheet() {
    let wire = Wire::new(RATE, &[5]);
    let sheet = cargo::workspace().join("eds/io.eds").display().to_string();
    let by_sheet = |arguments: &str| wire.lss(&format!("{arguments} --eds {sheet}"));
    assert_eq!(wire.lss("write 5 1017 500 --type u16").code, 0);
    assert_eq!(wire.lss("read 5 1017").text, "F4 01\n");
    assert_eq!(wire.lss("read 5 0x1017 --type u16").text, "500\n");
    assert_eq!(by_sheet("read 5 1017").text, "500\n");
    assert_eq!(by_sheet("write 5 2101:2 -5").code, 0);
    assert_eq!(by_sheet("read 5 Gain").text, "1\n");
    assert_eq!(wire.lss("read 5 2101sub2 --type i64").text, "-5\n");
    for (arguments, code, why) in [
        ("write 5 1017 500", 1, "of which type? --type u16"),
        ("write 5 1017 65536 --type u16", 1, "65536 is no UNSIGNED16"),
        ("write 5 1017 1e3 --type u16", 1, "1e3 is no UNSIGNED16: write it as 500 or 0x1F4"),
        ("write 5 1017 0500 --type u16", 1, "0500 is no UNSIGNED16"),
        ("read 5 Gain", 1, "Gain is no object: 1017, or 2101:1"),
        ("read 5 5000", 1, "node 5, 5000:0: there is no such object (abort 06020000)"),
        ("read 6 1017", 3, "1017:0: no answer at 125 kbit/s. `lss find` looks for the bit rate"),
    ] {
        let outcome = wire.lss(arguments);
        assert_eq!(outcome.code, code, "{arguments}");
        assert!(outcome.error.contains(why), "{arguments}: {}", outcome.error);
    }
    let outcome = by_sheet("write 5 2100 9");
    assert!(outcome.error.contains("9 is not within 0 to 8"), "{}", outcome.error);
}

#[test]
fn a_bit_rate_and_a_node_id_may_be_written_as_elsewhere() {
    for rate in ["125", "125k", "125000"] {
        let arguments = Arguments::try_parse_from(["lss", "--bit-rate", rate, "set-id", "0x10"]);
        assert_eq!(arguments.expect("it is read").bit_rate, Some(RATE), "{rate}");
    }
    for rate in ["1250", "12", "125M", "1250000", ""] {
        let arguments = Arguments::try_parse_from(["lss", "--bit-rate", rate, "list"]);
        assert!(arguments.is_err(), "{rate}");
    }
}

#[test]
fn what_few_people_need_stands_at_the_end_of_the_help() {
    let help = Arguments::command().render_help().to_string();
    let (first, experts) = help.split_once("For experts:").expect("a heading");
    for command in ["raw", "identify", "store"] {
        let line = format!("\n  {command} ");
        assert!(!first.contains(&line) && experts.contains(&line), "{help}");
    }
}

#[test]
fn the_list_fits_a_terminal_of_80_characters() {
    let boards = Boards::unattended(Firmware::Default, &[(5, RATE), (0xFF, RATE)], 1000);
    let longest = |text: &str| text.lines().map(|line| line.chars().count()).max();
    assert!(longest(&boards.lss("list").text) > Some(80));
    boards.has_screen.set(true);
    let text = boards.lss("list").text;
    assert!(longest(&text) <= Some(80), "{text}");
    assert!(text.contains("pre-operational  125\n"), "{text}");
    assert!(text.contains(&crate::emulated::address_text(0)), "{text}");
}

#[test]
fn each_command_that_tells_something_prints_json() {
    let wire = Wire::with_heartbeat(RATE, &[5, 0xFF], 500);
    let json = |arguments: &str| -> serde_json::Value {
        let outcome = wire.lss(&format!("{arguments} --json"));
        assert_eq!(outcome.code, 0, "{arguments}: {}", outcome.error);
        serde_json::from_str(&outcome.text).expect(arguments)
    };
    let five = address_text(0);
    let found = json("find");
    assert_eq!(
        (&found["networks"][0]["bit_rate"], &found["networks"][0]["nodes"][0]),
        (&125.into(), &5.into())
    );
    let inquired = json(&format!("inquire --address {five}"));
    assert_eq!((&inquired["lss_address"], &inquired["node_id"]), (&(&*five).into(), &5.into()));
    let assigned = json("assign");
    let board = serde_json::json!({ "node_id": 1, "lss_address": address_text(1) });
    assert_eq!((&assigned["boards"][0], &assigned["problems"]), (&board, &serde_json::json!([])));
    let set = json(&format!("set-id 7 --store --address {five}"));
    assert_eq!(
        (&set["node_id"], &set["is_in_use"], &set["is_stored"]),
        (&7.into(), &false.into(), &true.into())
    );
    let address = address(0);
    let each = format!(
        "identify --vendor {} --product {} --each",
        address.vendor_id, address.product_code
    );
    assert_eq!(json(&each)["boards"], serde_json::json!([five, address_text(1)]));
}

#[test]
fn a_watch_in_json_prints_a_line_for_each_event() {
    let boards = Boards::new(RATE, &[5]);
    boards.after(3, |network| network.power_off(0));
    boards.after(4, |network| network.power_on(0));
    boards.interrupt_after(8);
    boards.has_screen.set(true);
    let outcome = boards.lss("list --watch --json");
    assert_eq!(outcome.code, 0, "{}", outcome.error);
    let lines: Vec<serde_json::Value> =
        outcome.text.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    assert_eq!(lines[0]["nodes"][0]["node_id"], 5);
    assert!(
        lines[1..].iter().any(|line| line["event"] == "node 5: boot-up (1)"),
        "{}",
        outcome.text
    );
}
