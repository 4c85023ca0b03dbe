//! `cargo emulate` as a child process.

use std::{
    io::{BufRead, BufReader, Write},
    net::SocketAddr,
    process::{Child, Stdio},
    sync::mpsc,
    thread,
    time::Duration,
};

use crate::cargo::cargo;

/// The wait for the first line: the emulator and the firmware may have to be built.
const BUILD: Duration = Duration::from_secs(1200);

/// Emulated boards in real time.
pub struct Emulated {
    child: Child,
    pub address: SocketAddr,
}

impl Emulated {
    /// Starts boards with these further arguments, on a free port.
    pub fn start(arguments: &[&str]) -> Self {
        let mut child = cargo()
            .args(["run", "--quiet", "--package", "xtask", "--", "emulate"])
            .args(["--listen", "127.0.0.1:0"])
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("cargo runs");
        let stdout = BufReader::new(child.stdout.take().expect("it is piped"));
        let (sender, lines) = mpsc::channel();
        thread::spawn(move || {
            // To the end, though nobody may want the log of a program.
            stdout.lines().map_while(Result::ok).for_each(|line| _ = sender.send(line));
        });
        let description = lines.recv_timeout(BUILD).expect("it starts");
        let address =
            description.strip_prefix("ready: SLCAN on ").and_then(|rest| rest.split(';').next());
        let address = address.and_then(|address| address.parse().ok()).expect("an address");
        Self { child, address }
    }

    /// Gives a command to the console; needs `--console`.
    pub fn command(&mut self, command: &str) {
        let console = self.child.stdin.as_mut().expect("it is piped");
        writeln!(console, "{command}").expect("it reads");
    }

    /// The adapter, as on a command line.
    pub fn adapter(&self) -> String {
        format!("slcan:tcp:{}", self.address)
    }
}

impl Drop for Emulated {
    fn drop(&mut self) {
        // It may have ended before.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
