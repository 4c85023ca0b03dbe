//! `cargo verify qemu`: compares the same session on QEMU's CPU and on the emulator's.

use std::{
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use anyhow::{Context, bail, ensure};
use emulator::{
    Time,
    board::{Board, Settings},
    can::{Adapter, Frame},
    image::Image,
    network::Network,
};
use testkit::{
    boards::FIRST_START,
    cargo::{TARGET, cargo, target_directory},
    explain::explain,
    frames::of_master,
    image::{self, PART},
    image_rig::DEFAULT_BIT_RATE,
    wire::{bit_per_s, on_the_wire},
};

use xtask::tool;

const QEMU: &str = "qemu-system-arm";
/// A QEMU machine with an STM32F4.
const MACHINE: &str = "netduinoplus2";
/// An instruction takes 2^3 ns, little more than a cycle at 160 MHz. Only the duration of a reset varies by some
/// microseconds from run to run.
const TIME: &str = "shift=3,sleep=off";
/// The interval between requests: enough for an answer, a store and a restart.
const INTERVAL: Time = Time::from_ms(50);

/// A frame on the bus: its time, `>` for a request of the master or `<` for a frame of the slave, and the frame.
type Seen = (Time, char, Frame);

/// Run a session on QEMU's CPU and on the emulator's, and check that they agree
///
/// QEMU runs the release image with the emulator's peripherals and bus as a plugin. Both must produce the same frames.
/// Needs `qemu-system-arm` 7.2 to 10.0.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments;

/// Prints the session. Fails if the runs differ in anything but times.
pub fn run() -> anyhow::Result<()> {
    let version = tool::version(QEMU, "Debian: apt-get install qemu-system-arm")?;
    let version = version.split_whitespace().nth(3).unwrap_or("unknown");
    let image = image::build(PART)?;
    let plugin = build_plugin()?;
    let output = run_qemu(&plugin)?;
    let ours = run_emulator(&image)?;

    println!("{:>11} {:>11}", "QEMU", "emulator");
    let mut lines = output.lines();
    for (our_time, direction, frame) in &ours {
        let line = lines.next().unwrap_or("the end");
        let (time, what) = line.split_once(' ').unwrap_or(("", line));
        let expected = format!("{direction} {frame}");
        ensure!(what == expected, "QEMU has `{line}` where the emulator has `{expected}`");
        println!("{time:>11} {our_time:>11} {expected:24} {}", explain(frame));
    }
    if let Some(line) = lines.next() {
        bail!("QEMU has `{line}` where the emulator's session has ended");
    }
    // Found, commissioned, stored, and still so after a restart.
    let end = ours.last().map(|(_, _, frame)| frame.to_string());
    ensure!(end.as_deref() == Some("7E4#5E05000000000000"), "the node-ID is not there at the end");
    println!("The two agree. Times are in ms; QEMU is {version}.");
    Ok(())
}

fn build_plugin() -> anyhow::Result<PathBuf> {
    let target = target_directory();
    let mut cargo = cargo();
    cargo.args(["build", "--package", "qemu-bridge", "--target-dir"]).arg(&target);
    tool::run(&mut cargo, "the plugin for QEMU does not build")?;
    Ok(target.join("debug/libqemu_bridge.so"))
}

/// The frames of the master: the complete configuration of a new slave with node-ID 5, and a check of it after a
/// restart.
fn session() -> impl Iterator<Item = Frame> {
    const SESSION: [&str; 15] = [
        "4C",
        "04 01",
        "5A",
        "5B",
        "5C",
        "5D",
        "5E",
        "11 80",
        "11 05",
        "17",
        "04 00",
        "605: 40 18 10 04 00 00 00 00",
        "000: 81 05",
        "04 01",
        "5E",
    ];
    SESSION.into_iter().map(|text| on_the_wire(&of_master(text)))
}

/// Runs QEMU and returns the output of the plugin: a line for each frame and each finding.
fn run_qemu(plugin: &Path) -> anyhow::Result<String> {
    let mut argument = plugin.display().to_string();
    for frame in session() {
        argument += &format!(",send={frame}");
    }
    let output = Command::new(QEMU)
        .args(["-machine", MACHINE, "-display", "none", "-serial", "none", "-monitor", "none"])
        .arg("-kernel")
        .arg(target_directory().join(TARGET).join("release/firmware"))
        .args(["-plugin", &argument, "-icount", TIME])
        .stdin(Stdio::null())
        .stderr(Stdio::inherit())
        .output()
        .context(format!("cannot run {QEMU}"))?;
    ensure!(
        output.status.success(),
        "{QEMU} failed, see above. The plugin needs QEMU 7.2 to 10.0 with plugins and its symbols \
         exported, as Debian builds it"
    );
    Ok(String::from_utf8(output.stdout)?)
}

/// Runs the same session on the emulator.
fn run_emulator(image: &Image) -> anyhow::Result<Vec<Seen>> {
    let mut network = Network::new();
    let board = network.add_board(Board::new(PART, image, Settings::default()));
    let adapter = network.add_adapter(Adapter::new(bit_per_s(DEFAULT_BIT_RATE)));
    let mut seen = Vec::new();
    network.run_until(FIRST_START);
    for frame in session() {
        seen.push((network.now(), '>', frame));
        network.send(adapter, frame);
        network.run_for(INTERVAL);
        while let Some((time, frame)) = network.receive(adapter) {
            seen.push((time, '<', frame));
        }
    }
    if let Some(finding) = network.board(board).findings().first() {
        bail!("on the emulator: {finding}");
    }
    Ok(seen)
}
