//! The output of the commands.
#![cfg(unix)]

use std::{io, process::Stdio};

#[test]
fn a_command_ends_quietly_when_nobody_reads_its_output() {
    let (reader, writer) = io::pipe().expect("a pipe");
    drop(reader);
    let mut verify = testkit::cargo::program("verify");
    verify.args(["power-cut", "--quick"]).stdin(Stdio::null()).stdout(writer);
    let output = verify.output().expect("it runs");
    // Cargo shows its progress there.
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(!said.contains("panicked") && !said.contains("error"), "{said}");
    assert_eq!(output.status.code(), Some(1));
}
