//! Boards broken on purpose: each fault is found and named, and the board is left as it was if that is possible.

use std::{
    io::{BufRead, BufReader},
    process::{Command, Stdio},
    time::Duration,
};

use testkit::emulated::Emulated;

use crate::{
    folder::new_folder,
    lone::Program,
    proxy::{self, Fault},
    run::{self, Run},
    whole::stored,
};

fn run_with(fault: Fault, session: &str) -> Run {
    let boards = Emulated::start(&["--node-id", "5"]);
    let adapter = proxy::start(boards.address, fault);
    run::run(&format!("{fault:?}-{session}"), &adapter, &["--session", session])
}

#[test]
fn the_line_itself_is_no_fault() {
    run_with(Fault::None, "bursts").assert_good();
}

#[test]
fn bit_rates_that_the_adapter_lacks_are_skipped_and_named() {
    let boards = Emulated::start(&["--node-id", "5"]);
    let adapter = proxy::start(boards.address, Fault::Esp32);
    let run = run::run("esp32", &adapter, &["--session", "activate", "--session", "store"]);
    run.assert_good();
    let (_, end) = run.output.split_once("Not tried:").expect("something is not tried");
    assert_eq!(end.matches("10 kbit/s: the adapter lacks it").count(), 2, "{end}");
}

#[test]
fn a_board_whose_own_bit_rate_the_adapter_lacks_has_it_again() {
    let flash = new_folder("esp32-flash");
    let arguments = ["--node-id", "5", "--bit-rate", "20", "--flash", &flash.to_string_lossy()];
    let boards = Emulated::start(&arguments);
    let adapter = proxy::start(boards.address, Fault::Esp32);
    let run = run::run("esp32-slow", &adapter, &["--session", "sdo"]);
    assert_eq!((run.failures(), run.is_success), (vec![], false));
    assert!(run.output.contains("has stored 20 kbit/s again, but the adapter lacks it"));
    assert_eq!(stored(&flash), (5, 7));
}

#[test]
fn late_answers_are_named() {
    let run = run_with(Fault::LateAnswers, "answers");
    run.assert_named("late answers");
    run.assert_left("restored");
}

#[test]
fn a_lost_request_is_named() {
    let run = run_with(Fault::LostRequest, "bursts");
    run.assert_named("a lost request: answers 5A 5B 5D 5E");
    run.assert_left("restored");
}

#[test]
fn a_board_that_does_not_store_is_named() {
    run_with(Fault::NoStore, "store").assert_named("the stored value is lost");
}

#[test]
fn a_blank_board_that_does_not_store_is_named() {
    let boards = Emulated::start(&[]);
    let adapter = proxy::start(boards.address, Fault::NoStore);
    let run = run::run("blank-no-store", &adapter, &["--session", "sdo"]);
    run.assert_named("does not store: node-ID 7E was acknowledged by 17 00");
    run.assert_left("restored");
}

#[test]
fn a_board_that_is_silent_after_a_switch_is_named() {
    let run = run_with(Fault::SilentAfterSwitch, "activate");
    run.assert_named("silent after the switch");
    run.assert_left("restored");
}

#[test]
fn a_silent_board_is_restored_by_an_adapter_that_lacks_the_slow_bit_rates() {
    let run = run_with(Fault::Esp32SilentAfterSwitch, "activate");
    run.assert_named("silent after the switch");
    run.assert_left("restored");
}

#[test]
fn a_board_that_cannot_be_brought_back_is_named_with_the_reason() {
    let run = run_with(Fault::SilentForEver, "activate");
    run.assert_named("the boards cannot be brought back to 125 kbit/s: board 515884C7");
    run.assert_named("board 515884C7 answers at no bit rate");
    run.assert_left("changed: board 515884C7 answers at no bit rate");
}

#[test]
fn a_port_that_forgets_to_report_none_pending_is_told_so() {
    let run = run_with(Fault::OneHeartbeat, "sdo");
    run.assert_named("a port that does not report BusEvent::NonePending");
    run.assert_left("restored");
}

#[test]
fn a_board_of_another_vendor_is_left_alone() {
    let run = run_with(Fault::OtherVendor, "services");
    run.assert_named("not our board: the LSS slave at 125 kbit/s has vendor-ID 000001A0");
    run.assert_left("untouched");
}

#[test]
fn a_second_master_is_named_and_nothing_is_changed() {
    let boards = Emulated::start(&["--node-id", "5"]);
    let mut other = Program::connect(boards.address);
    other.send("S4");
    other.send("O");
    std::thread::spawn(move || {
        while other.try_send("t7E580400000000000000") {
            std::thread::sleep(Duration::from_millis(50));
        }
    });
    let run = run::run("two-masters", &boards.adapter(), &[]);
    run.assert_named("two masters");
    run.assert_left("untouched");
}

#[test]
fn an_adapter_that_vanishes_and_comes_back_restores_the_board() {
    let run = run_with(Fault::VanishesOnce, "services");
    run.assert_named("the adapter has vanished");
    run.assert_left("restored");
}

#[test]
fn an_adapter_that_vanishes_for_ever_ends_the_run() {
    let run = run_with(Fault::Vanishes, "services");
    run.assert_named("the adapter has vanished");
    run.assert_left("changed");
    assert!(run.took < Duration::from_secs(60), "{:?}", run.took);
    assert!(
        run.output.contains("The settings were, board 515884C7: node-ID 5, 125 kbit/s"),
        "{}",
        run.output
    );
}

#[test]
fn ctrl_c_restores_the_board() {
    let boards = Emulated::start(&[]);
    let folder = new_folder("ctrl-c");
    let mut command =
        run::command(&folder, &boards.adapter(), &["--session", "activate", "--quick"]);
    let mut child = command.stdout(Stdio::piped()).spawn().expect("it runs");
    let mut lines =
        BufReader::new(child.stdout.take().expect("it is piped")).lines().map_while(Result::ok);
    lines.find(|line| line.contains("1000 kbit/s by activation")).expect("the session begins");
    let killed = Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(killed.is_ok_and(|status| status.success()));
    lines.for_each(drop);
    let run = Run::new(&folder, child.wait_with_output().expect("it ends"), Duration::ZERO);
    run.assert_named("interrupted");
    run.assert_left("restored");
}

/// 10 and 20 kbit/s have 11 bits that are longer than the dominant time-out of a common transceiver.
#[test]
#[ignore = "takes 80 s; `.ci/run chips` runs it"]
fn a_transceiver_that_bears_no_slow_rates_is_named_and_the_board_restored() {
    let boards = Emulated::start(&["--node-id", "5", "--time-out", "450"]);
    for (session, how) in [("activate", "activation"), ("store", "store and reset")] {
        let run = run::run(&format!("slow-{session}"), &boards.adapter(), &["--session", session]);
        run.assert_named(&format!("10 kbit/s by {how}: silent after the switch"));
        assert!(run.output.contains("transceiver suspected: only slow bit rates fail"));
        run.assert_left("restored");
    }
}
