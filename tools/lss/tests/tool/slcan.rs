//! The program `lss` over SLCAN, with `cargo emulate` in real time.

use std::{
    fs,
    io::{BufRead, BufReader},
    process::{Command, Output, Stdio},
    thread,
    time::Duration,
};

use testkit::{cargo, emulated::Emulated};

fn lss(boards: &Emulated, arguments: &[&str]) -> Command {
    let mut command = cargo::program("lss");
    command.env("LSS_ADAPTER", boards.adapter()).args(arguments);
    command
}

#[track_caller]
fn text(output: &Output, code: i32) -> String {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let (out, error) = (text(&output.stdout), text(&output.stderr));
    assert_eq!(output.status.code(), Some(code), "{out}{error}");
    out
}

#[test]
fn a_box_of_new_boards_becomes_a_running_network() {
    let boards = Emulated::start(&["--boards", "2"]);
    let run = |arguments: &[&str]| {
        let output = lss(&boards, arguments).output().expect("it runs");
        println!("{}", String::from_utf8_lossy(&output.stderr));
        text(&output, 0)
    };
    let found = run(&["find", "--ask", "--bit-rate", "500"]);
    assert!(found.contains("the network runs at 125 kbit/s, and not at 500 kbit/s"), "{found}");
    let assigned = run(&["assign"]);
    assert_eq!(assigned.matches("stored, verified by a reset").count(), 2, "{assigned}");
    let log = cargo::scratch("set-rate.log");
    let switched = run(&["set-rate", "250", "--log", &log.to_string_lossy()]);
    assert!(switched.ends_with("2 boards answered at 250 kbit/s and stored it\n"));
    let log = fs::read_to_string(log).expect("a log");
    assert_eq!(log.matches(" can0 7E5#15").count(), 1, "{log}");
    let listed = run(&["list", "--bit-rate", "250"]);
    assert_eq!(listed.matches("LSS slave").count(), 2, "{listed}");
}

#[test]
fn ctrl_c_ends_the_program_and_leaves_no_board_in_configuration_state() {
    let boards = Emulated::start(&["--boards", "2", "--node-id", "5"]);
    let arguments = ["list", "--explain"];
    let child = lss(&boards, &arguments).stderr(Stdio::piped()).spawn();
    let child = child.expect("it runs");
    thread::sleep(Duration::from_millis(1500));
    let killed = Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(killed.is_ok_and(|status| status.success()));
    let output = child.wait_with_output().expect("it ends");
    text(&output, 130);
    let error = String::from_utf8_lossy(&output.stderr);
    let last = error.lines().rfind(|line| line.contains("  7E5  "));
    assert!(last.is_some_and(|line| line.ends_with("switch state global: waiting")), "{error}");
    assert!(error.ends_with("error: interrupted\n"), "{error}");
}

#[test]
fn ctrl_c_ends_a_watch_as_it_should() {
    let boards = Emulated::start(&["--boards", "2", "--node-id", "5"]);
    let arguments = ["list", "--watch", "--explain"];
    let mut child = lss(&boards, &arguments)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("it runs");
    // It stays open.
    let mut lines = BufReader::new(child.stdout.take().expect("it is piped")).lines();
    let table: Vec<String> = lines.by_ref().map_while(Result::ok).take(3).collect();
    assert!(table[2].contains("LSS slave"), "{table:?}");
    thread::sleep(Duration::from_millis(500));
    let killed = Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(killed.is_ok_and(|status| status.success()));
    let output = child.wait_with_output().expect("it ends");
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{error}");
    // Every line is a frame: nothing is an error.
    let is_frame =
        |line: &str| line.get(..9).is_some_and(|time| time.trim().parse::<f64>().is_ok());
    assert!(error.lines().all(is_frame), "{error}");
}

#[cfg(unix)]
#[test]
fn on_a_full_disk_no_board_gets_a_node_id_and_the_table_stays() {
    let boards = Emulated::start(&["--boards", "1"]);
    let table = cargo::scratch("full-disk.toml");
    let path = table.display();
    let missing = "[[node]]\nid = 5\naddress = \"00000000:4C535334:00010000:00000007\"\n";
    // A file of this length cannot grow, whether the shell counts in 512 bytes or in 1024.
    let text = format!("{missing}#{}\n", " ".repeat(1000 - missing.len() - 2));
    let empty = format!("#{}\n", " ".repeat(998));
    for (text, options) in [(&empty, ""), (&text, "--yes")] {
        fs::write(&table, text).expect("it can be written");
        let script = format!(
            "trap '' XFSZ; ulimit -f 1; exec {} assign --table {path} {options}",
            cargo::program("lss").get_program().display()
        );
        let mut command = Command::new("sh");
        command.env("LSS_ADAPTER", boards.adapter()).args(["-c", &script]);
        let output = command.output().expect("it runs");
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{error}");
        assert!(error.trim_end().ends_with(" got no node-ID"), "{error}");
        assert_eq!(fs::read_to_string(&table).expect("it is there"), **text);
        let listed = lss(&boards, &["list"]).output().expect("it runs");
        assert!(text_of_none(&listed), "it has a node-ID");
    }
    // With room it goes on.
    let output = lss(&boards, &["assign", "--yes", "--table", &path.to_string()]).output();
    let assigned = self::text(&output.expect("it runs"), 0);
    assert!(assigned.contains("takes over the place of"), "{assigned}");
}

/// Whether the list has a board without a node-ID, and no other.
#[cfg(unix)]
fn text_of_none(output: &Output) -> bool {
    let listed = text(output, 0);
    listed.lines().count() == 2 && listed.contains("\nnone  ")
}
