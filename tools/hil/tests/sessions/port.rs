//! The port to embassy-stm32 on its emulated chips: the same sessions as for our own board. `.ci/run ports` builds it.

use std::{
    io::{BufRead, BufReader, Read, Write},
    process::{Output, Stdio},
    time::Duration,
};

use testkit::{cargo, emulated::Emulated};

use crate::{
    folder::new_folder,
    lone::Program,
    run::{self, Run},
    whole::HANDS,
};

/// Defines a test of each property with each chip.
macro_rules! shown_on {
    ($($chip:ident),*: $properties:tt) => {$(
        mod $chip {
            shown_on!(@ $chip $properties);
        }
    )*};
    (@ $chip:ident { $($property:ident),* }) => {$(
        #[test]
        #[ignore = "needs the program: `.ci/run ports`"]
        fn $property() {
            super::$property(stringify!($chip));
        }
    )*};
}

shown_on! { stm32f407, stm32g431: {
    the_port_passes_the_whole_session,
    the_port_passes_beside_our_own_board,
    the_port_keeps_its_settings_through_a_power_cut_and_recovers_from_bus_off,
    the_port_alone_on_its_bus_answers_a_late_master
} }

/// The port on this chip, beside this number of our own boards.
fn start(chip: &str, boards: &str, arguments: &[&str]) -> Emulated {
    let program = cargo::workspace().join(format!("target/embassy/{chip}.elf"));
    let program = program.to_string_lossy();
    let crystal = if chip == "stm32g431" { "24" } else { "8" };
    let chip = ["--boards", boards, "--chip", chip, "--crystal", crystal, "--elf", &program];
    Emulated::start(&[&chip[..], arguments].concat())
}

fn the_port_passes_the_whole_session(chip: &str) {
    let port = start(chip, "0", &[]);
    let folder = new_folder(&format!("port-{chip}"));
    let output = run::command(&folder, &port.adapter(), &[]).output().expect("it runs");
    Run::new(&folder, output, Duration::ZERO).assert_good();
}

fn the_port_passes_beside_our_own_board(chip: &str) {
    let boards = start(chip, "1", &[]);
    let sessions = [
        "services", "answers", "bursts", "sdo", "nmt", "fastscan", "activate", "switch", "store",
        "detect", "rescue",
    ];
    let arguments: Vec<_> = sessions.iter().flat_map(|name| ["--session", *name]).collect();
    let run = run::run(&format!("port-beside-{chip}"), &boards.adapter(), &arguments);
    run.assert_good();
    assert_eq!(run.report["boards"].as_array().map(Vec::len), Some(2));
}

fn the_port_keeps_its_settings_through_a_power_cut_and_recovers_from_bus_off(chip: &str) {
    let mut port = start(chip, "0", &["--console"]);
    let folder = new_folder(&format!("port-hands-{chip}"));
    let mut command = run::command(&folder, &port.adapter(), &HANDS);
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("it runs");
    child.stdin.as_mut().expect("it is piped").write_all(b"y\ny\n").expect("it reads");
    let mut stdout = Vec::new();
    for line in BufReader::new(child.stdout.take().expect("it is piped")).lines() {
        let line = line.expect("UTF-8");
        let commands = match &line {
            line if line.contains("now: switch the power off") => ["power off", "power on"],
            line if line.contains("now: connect CANH and CANL") => ["short on", "short off"],
            _ => ["", ""],
        };
        for command in commands.into_iter().filter(|command| !command.is_empty()) {
            port.command(command);
            std::thread::sleep(Duration::from_secs(2));
        }
        stdout.extend(line.bytes().chain([b'\n']));
    }
    let status = child.wait().expect("it ends");
    let run = Run::new(&folder, Output { status, stdout, stderr: Vec::new() }, Duration::ZERO);
    run.assert_good();
    assert!(run.output.contains("passed  settings through a power cut"));
    assert!(run.output.contains("passed  after a short circuit"));
}

/// Sends these lines until the adapter says `answer`.
fn ask(master: &mut Program, lines: &[&str], answer: &str) {
    let mut said = String::new();
    for _ in 0..40 {
        lines.iter().for_each(|line| master.send(line));
        while let Ok(1..) = (&master.0).take(1).read_to_string(&mut said) {}
        if said.contains(answer) {
            return;
        }
    }
    panic!("{answer} is not in {said}");
}

fn the_port_alone_on_its_bus_answers_a_late_master(chip: &str) {
    let port = start(chip, "0", &[]);
    let mut master = Program::connect(port.address);
    master.0.set_read_timeout(Some(Duration::from_millis(500))).expect("a socket");
    for line in ["S4", "O"] {
        master.send(line);
    }
    ask(&mut master, &["t7E580401000000000000", "t7E581105000000000000"], "t7E481100");
    ask(&mut master, &["t7E580400000000000000"], "t705100");
    // Nobody acknowledges the heartbeats of the next seconds.
    master.send("C");
    std::thread::sleep(Duration::from_secs(4));
    for line in ["S4", "O"] {
        master.send(line);
    }
    ask(&mut master, &["t7E580401000000000000", "t7E585E00000000000000"], "t7E485E05");
}
