//! The output of the commands.
#![cfg(unix)]

use std::{
    io,
    process::{Command, Stdio},
};

#[test]
fn a_command_ends_quietly_when_nobody_reads_its_output() {
    let (reader, writer) = io::pipe().expect("a pipe");
    drop(reader);
    let mut verify = Command::new(env!("CARGO_BIN_EXE_verify"));
    verify.args(["soak", "--quick"]).stdin(Stdio::null()).stdout(writer);
    let output = verify.output().expect("it runs");
    assert_eq!(String::from_utf8_lossy(&output.stderr), "");
    assert_eq!(output.status.code(), Some(1));
}
