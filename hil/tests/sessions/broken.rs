//! Boards broken on purpose: each fault is found and named, and the board is left as it was if that is possible.

use std::{
    fs,
    io::{BufRead, BufReader},
    process::{Command, Stdio},
    time::Duration,
};

use canopen_node::BitRate;
use emulator::{
    Time,
    chip::{Access, Width},
};
use testkit::{
    image::Firmware,
    image_rig::{ImageRig, board_with, settings},
};

use crate::{
    emulated::{Directory, Emulated},
    lone::Program,
    proxy::{self, Fault},
    run::{self, Run},
};

/// RCC_CR, PLLCFGR, CFGR, APB1ENR; FLASH_ACR; CAN_MCR, IER, ESR, BTR; CAN's filters.
const REGISTERS: [u32; 20] = [
    0xE004_2000,
    0x1FFF_7A20,
    0x4002_3C14,
    0x4000_7004,
    0x4002_3800,
    0x4002_3804,
    0x4002_3808,
    0x4002_3840,
    0x4002_3C00,
    0x4000_6400,
    0x4000_6414,
    0x4000_6418,
    CAN_BTR,
    0x4000_6600,
    0x4000_6604,
    0x4000_660C,
    0x4000_6614,
    0x4000_661C,
    0x4000_6640,
    0x4000_6644,
];
const CAN_BTR: u32 = 0x4000_641C;

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
    run_with(Fault::NoStore, "store").assert_named("the value of 17 is lost");
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
fn a_wrong_sample_point_is_named_by_the_probe() {
    let directory = Directory::new("probe");
    // The registers of an emulated board in the same state, but for the sample point.
    let rate = BitRate::Kbit125;
    let mut rig = ImageRig::new(rate, [board_with(Firmware::Default, 0, settings(5, rate))]);
    rig.network.run_for(Time::from_ms(500));
    let mut script = "#!/bin/sh\ncase $5 in\n".to_owned();
    for address in REGISTERS {
        let board = rig.network.board(0);
        let access = Access { address, width: Width::Word, now: board.now(), pc: 0 };
        let value = board.chip().read(access).expect("a register");
        let value = if address == CAN_BTR { 0x0067_000F } else { value };
        script += &format!("{address:#X}) echo {value:08x};;\n");
    }
    let program = directory.0.join("probe-rs");
    fs::write(&program, script + "*) echo no such register >&2; exit 1;;\nesac\n")
        .expect("it can be written");
    let status = Command::new("chmod").arg("+x").arg(&program).status();
    assert!(status.is_ok_and(|status| status.success()));

    let boards = Emulated::start(&["--node-id", "5"]);
    let report = Directory::new("probe-report");
    let mut command = run::command(
        &report,
        &boards.adapter(),
        &["--session", "registers", "--probe", "stm32f405"],
    );
    let path = std::env::var("PATH").unwrap_or_default();
    let output =
        command.env("PATH", format!("{}:{path}", directory.path())).output().expect("it runs");
    let run = Run::new(report, output, Duration::ZERO);
    assert_eq!(run.failures(), ["CAN_BTR: 0067000F (156 kbit/s, sample point 56 %)"]);
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
    let directory = Directory::new("ctrl-c");
    let mut command = run::command(&directory, &boards.adapter(), &["--session", "activate"]);
    let mut child = command.stdout(Stdio::piped()).spawn().expect("it runs");
    let mut lines =
        BufReader::new(child.stdout.take().expect("it is piped")).lines().map_while(Result::ok);
    lines.find(|line| line.contains("1000 kbit/s by activation")).expect("the session begins");
    let killed = Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(killed.is_ok_and(|status| status.success()));
    lines.for_each(drop);
    let run = Run::new(directory, child.wait_with_output().expect("it ends"), Duration::ZERO);
    run.assert_named("interrupted");
    run.assert_left("restored");
}
