//! The program `lss` itself: its adapters and its command line.

use std::{net::TcpListener, process::Output};

use testkit::cargo;

fn lss(arguments: &[&str]) -> Output {
    cargo::program("lss").env_remove("LSS_ADAPTER").args(arguments).output().expect("it runs")
}

#[track_caller]
fn assert_fails(arguments: &[&str], code: i32, words: &str) {
    let output = lss(arguments);
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(error.contains(words), "{error}");
    assert_eq!(output.status.code(), Some(code));
}

#[test]
fn a_missing_adapter_is_told() {
    assert_fails(&["find"], 2, "which CAN adapter? --adapter slcan:/dev/ttyACM0");
    let adapter = "slcan:/dev/ttyNone";
    assert_fails(&["inquire", "--adapter", adapter], 4, "no adapter: slcan:/dev/ttyNone");
    assert_fails(&["inquire", "--adapter", "socketcan:none0"], 4, "no adapter: socketcan:none0");
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let adapter = format!("slcan:tcp:{}", listener.local_addr().expect("it is bound"));
    drop(listener);
    assert_fails(&["inquire", "--adapter", &adapter], 4, "no adapter: slcan:tcp:127.0.0.1:");
}

#[cfg(target_os = "linux")]
#[test]
fn an_interface_that_is_up_is_not_taken_down() {
    let words = "socketcan:lo is up. socketcan:lo@125 uses it as it is";
    assert_fails(&["list", "--adapter", "socketcan:lo"], 4, words);
    assert_fails(&["list", "--adapter", "socketcan:lo@125"], 4, "it is no CAN interface");
}

#[test]
fn the_completion_needs_no_adapter() {
    let output = lss(&["completion", "bash"]);
    assert!(output.status.success());
    let script = String::from_utf8_lossy(&output.stdout);
    for word in ["set-rate", "--watch", "--power-check", "--yes", "--svg"] {
        assert!(script.contains(word), "{word}");
    }
}

#[test]
fn a_wrong_command_line_is_told() {
    let adapter = ["--adapter", "slcan:/dev/ttyNone"];
    let wrong = |rest: &[&str], words: &str| assert_fails(&[&adapter[..], rest].concat(), 2, words);
    wrong(&["set-id", "128"], "1 to 127, or none");
    wrong(&["set-id", "0"], "1 to 127, or none");
    wrong(&["raw", "xx"], "a byte in hexadecimal");
    wrong(&["identify", "--vendor", "1", "--product", "2", "--serial", "2..1"], "is greater than");
    wrong(&["identify", "--vendor", "1", "--product", "1-2"], "a number of 32 bits");
    wrong(&["identify", "--vendor", "1", "--product", "2", "--serial", "1.."], "a number of 32");
    wrong(&["read", "5", "1017", "--type", "word"], "bool, i8, i16");
    wrong(&["assign", "--yes"], "--table <FILE>");
    for address in ["1:2:3", "1:2:3:4:5", "1:2:3:x"] {
        wrong(&["store", "--address", address], "vendor-ID:product code:revision:serial number");
    }
    wrong(&["inquire", "--bit-rate", "100"], "is no bit rate of CiA 301 in kbit/s: 1000, 800,");
}
