//! Whole boards: everything passes, and they are left as they were found.

use std::{
    fs,
    io::{BufRead, BufReader, Write},
    path::Path,
    process::{Output, Stdio},
    time::{Duration, Instant},
};

use canopen_node::settings::Log;
use testkit::{
    emulated::Emulated,
    flash::BoardFlash,
    image_rig::{SETTINGS_LENGTH, SETTINGS_OFFSET},
};

use crate::{
    folder::new_folder,
    lone::Program,
    proxy::{self, Fault},
    run::{self, Run},
};

/// The session with a person who is there.
pub const HANDS: [&str; 5] = ["--session", "hands", "--ask", "always", "--quick"];

/// The settings in the flash file of the first board: node-ID or FF, and the index of the bit rate.
pub fn stored(folder: &Path) -> (u8, u8) {
    let flash = fs::read(folder.join("board-0.bin")).expect("a flash file");
    let log = flash[SETTINGS_OFFSET as usize..][..SETTINGS_LENGTH].to_vec();
    let settings =
        Log::open(BoardFlash::with_content(log, 0)).0.settings().expect("stored settings");
    (canopen_node::NodeId::to_lss(settings.node_id), settings.bit_rate.index())
}

#[test]
fn a_blank_board_passes_the_whole_session_and_stays_as_it_was() {
    let flash = new_folder("blank");
    let boards = Emulated::start(&["--flash", &flash.to_string_lossy()]);
    let folder = new_folder("whole");
    let begin = Instant::now();
    let output = run::command(&folder, &boards.adapter(), &["--chip", "stm32f407"])
        .output()
        .expect("it runs");
    let run = Run::new(&folder, output, begin.elapsed());
    run.assert_good();
    assert!(run.took < Duration::from_secs(300), "{:?}", run.took);
    assert_eq!(stored(&flash), (0xFF, 4));

    let file = |name: &str| fs::read_to_string(folder.join(name)).expect(name);
    let page = file("report.html");
    assert!(file("report.txt").contains("The boards are as they were found."));
    let head = &run.report["head"];
    let text = |key: &str| head[key].as_str().expect(key).to_owned();
    assert!(text("date").ends_with(" UTC") && text("version").contains(" (commit "));
    assert!(text("product").ends_with("by this firmware (src/device.rs)"), "{head}");
    assert_eq!(text("chip"), "stm32f407");
    assert!(text("adapter").starts_with("slcan:tcp:"));
    for value in ["date", "version", "product", "chip"].map(text) {
        assert!(page.contains(&value) && file("report.txt").contains(&value), "{value}");
    }
    for check in run.report["checks"].as_array().expect("checks") {
        let is_there = |key: &str| check[key].as_str().is_some_and(|text| !text.is_empty());
        assert!(is_there("what") && is_there("seen") && is_there("rule"), "{check}");
        assert_eq!(is_there("expected"), check["outcome"] != "not tried", "{check}");
        let name = check["what"].as_str().expect("a name");
        assert!(
            !name.starts_with(|c: char| c.is_ascii_digit()) || name.contains("bit/s"),
            "{name}"
        );
    }
    assert!(run.report["answers"].as_array().is_some_and(|answers| answers.len() > 400));
    assert!(run.report["switches"].as_array().is_some_and(|switches| switches.len() == 4));
}

#[test]
fn three_boards_at_another_rate_keep_their_settings() {
    let flash = new_folder("three");
    let arguments = ["--boards", "3", "--node-id", "5", "--bit-rate", "500", "--flash"];
    let boards = Emulated::start(&[&arguments[..], &[&flash.to_string_lossy()]].concat());
    let sessions = ["--session", "bursts", "--session", "fastscan", "--session", "rescue"];
    let run = run::run("three-run", &boards.adapter(), &sessions);
    run.assert_good();
    assert_eq!(run.report["boards"].as_array().map(Vec::len), Some(3));
    assert_eq!(stored(&flash), (5, 2));
}

#[test]
fn a_board_that_detects_the_bit_rate_still_does_afterwards() {
    let flash = new_folder("automatic");
    let path = &flash.to_string_lossy();
    {
        // Index 9 and a node-ID, stored by a run that is cut off before it restores.
        let boards = Emulated::start(&["--node-id", "9", "--flash", path]);
        let mut master = Program::connect(boards.address);
        for line in
            ["S4", "O", "t7E580401000000000000", "t7E581300090000000000", "t7E581700000000000000"]
        {
            master.send(line);
        }
        std::thread::sleep(Duration::from_millis(500));
    }
    assert_eq!(stored(&flash), (9, 9));
    let boards = Emulated::start(&["--flash", path]);
    let run = run::run("automatic-run", &boards.adapter(), &["--session", "sdo"]);
    run.assert_good();
    assert!(
        run.report["boards"][0]
            .as_str()
            .is_some_and(|board| board.contains("node-ID 9, automatic"))
    );
    assert_eq!(stored(&flash), (9, 9));
}

#[test]
fn a_person_is_asked_to_cut_the_power() {
    let boards = Emulated::start(&["--node-id", "5"]);
    let adapter = proxy::start(boards.address, Fault::PowerCut);
    let folder = new_folder("person");
    let mut command = run::command(&folder, &adapter, &HANDS);
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("it runs");
    // Yes to the power cut, no to the short circuit.
    child.stdin.take().expect("it is piped").write_all(b"y\n\n").expect("it reads");
    let run = Run::new(&folder, child.wait_with_output().expect("it ends"), Duration::ZERO);
    run.assert_good();
    assert!(run.output.contains("passed  settings through a power cut"));
    assert!(run.output.contains("not tried  bus-off by a short circuit: nobody has agreed to it"));
}

#[test]
fn a_short_circuit_makes_the_boards_go_bus_off_and_come_back() {
    let mut boards = Emulated::start(&["--node-id", "5", "--console"]);
    let folder = new_folder("short");
    let mut command = run::command(&folder, &boards.adapter(), &HANDS);
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("it runs");
    // No to the power cut, yes to the short circuit.
    child.stdin.as_mut().expect("it is piped").write_all(b"\ny\n").expect("it reads");
    let mut stdout = Vec::new();
    for line in BufReader::new(child.stdout.take().expect("it is piped")).lines() {
        let line = line.expect("UTF-8");
        if line.contains("now: connect CANH and CANL") {
            boards.command("short on");
            std::thread::sleep(Duration::from_secs(2));
            boards.command("short off");
        }
        stdout.extend(line.bytes().chain([b'\n']));
    }
    let status = child.wait().expect("it ends");
    let output = Output { status, stdout, stderr: Vec::new() };
    let run = Run::new(&folder, output, Duration::ZERO);
    run.assert_good();
    assert!(run.output.contains("passed  after a short circuit"));
    assert!(run.output.contains("recoveries from bus-off, 2000h sub 1"));
}

#[cfg(unix)]
mod serial {
    use std::{
        io::{ErrorKind, Read},
        net::TcpStream,
        thread,
    };

    use nix::{
        fcntl::OFlag,
        pty::{grantpt, posix_openpt, ptsname_r, unlockpt},
    };

    use super::*;

    /// A serial line to the boards. It ends when the program sends `end`. Returns its name.
    fn line(boards: &Emulated, end: &'static str) -> String {
        // Children must not hold the line open.
        let flags = OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_NONBLOCK | OFlag::O_CLOEXEC;
        let mut master = posix_openpt(flags).expect("a pseudo terminal");
        grantpt(&master).and_then(|()| unlockpt(&master)).expect("it is ours");
        let name = ptsname_r(&master).expect("it has a name");
        let mut bus = TcpStream::connect(boards.address).expect("it listens");
        bus.set_nodelay(true).expect("it is connected");
        bus.set_read_timeout(Some(Duration::from_millis(1))).expect("not zero");
        thread::spawn(move || {
            let mut bytes = [0; 256];
            let mut sent = String::new();
            loop {
                // Errors: nothing came yet, or the program has not opened its end.
                if let Ok(count) = master.read(&mut bytes) {
                    sent += &String::from_utf8_lossy(&bytes[..count]);
                    if sent.contains(end) || bus.write_all(&bytes[..count]).is_err() {
                        return;
                    }
                }
                match bus.read(&mut bytes) {
                    Ok(count) => _ = master.write_all(&bytes[..count]),
                    Err(error)
                        if [ErrorKind::WouldBlock, ErrorKind::TimedOut].contains(&error.kind()) => {
                    }
                    Err(_) => return,
                }
            }
        });
        name
    }

    #[test]
    fn a_serial_line_serves_as_well() {
        let boards = Emulated::start(&["--node-id", "5", "--bit-rate", "250"]);
        let adapter = format!("slcan:{}", line(&boards, "nothing"));
        run::run("serial", &adapter, &["--session", "answers", "--session", "activate"])
            .assert_good();
    }

    #[test]
    fn a_serial_port_that_vanishes_ends_the_run_in_words() {
        let boards = Emulated::start(&["--node-id", "5"]);
        // Activate bit timing.
        let adapter = format!("slcan:{}", line(&boards, "t7E5815"));
        let run = run::run("vanishes", &adapter, &["--session", "activate"]);
        run.assert_named("the adapter has vanished");
        run.assert_left("changed: no adapter");
        assert!(run.took < Duration::from_secs(40), "{:?}", run.took);
    }
}
