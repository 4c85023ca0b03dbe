//! `cargo verify linux`: sessions over SocketCAN, in a Linux of its own on the bus of emulated boards.

mod system;

use std::{
    io::{self, BufRead, BufReader, Write},
    net::TcpListener,
    path::Path,
    process::{Child, Command, Stdio},
    sync::mpsc::{self, RecvTimeoutError, SyncSender},
    thread,
    time::{Duration, Instant},
};

use anyhow::{Context, bail, ensure};
use emulator::{
    can::{Frame, Id},
    network::{Network, Recording},
};
use testkit::{
    boards::{self, FIRST_START},
    explain::explain,
    image::{self, PART},
    image_rig::DEFAULT_BIT_RATE,
};

use system::System;
use xtask::emulate::{
    self, Surroundings,
    client::{self, Input},
};

/// The sessions begin with boards 0 and 1; the others have no power yet.
const BOARDS: usize = 4;
const POWERED: usize = 2;
/// Linux is stopped when it prints nothing for this long.
const SILENCE: Duration = Duration::from_secs(120);
/// Begins a line for the host: a command of the console of `cargo emulate`, or `end` and an exit status.
const TO_HOST: &str = "host: ";

/// Boot Debian's kernel in QEMU, with emulated boards on its SocketCAN, and run sessions with them
///
/// The interface is slcan0: `slcand` on a serial line that leads to the bus of `cargo emulate`. Two sessions run, one with
/// cansend and candump and one with python-canopen. Each configures two blank boards, switches the bit rate, and cuts
/// the power. Everything that the bus shows is printed.
///
/// Needs Debian 12 or 13 on x86-64, `qemu-system-x86_64` and python3 with venv. The first run downloads 100 MB of
/// packages into target/linux and installs none of them.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// Run this program of this computer, with its arguments, in place of the sessions
    ///
    /// It finds slcan0 at 125 kbit/s, and two blank boards, whose serial numbers are the first two in the variable
    /// `serial_numbers`. A request is answered after 45 ms: the serial line has 115,200 baud. To switch
    /// the power of a board it prints `host: power off 0` and waits for an empty line.
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    program: Vec<String>,
}

/// Runs the sessions or the program. Fails if anything is not as expected.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let started = Instant::now();
    if let Some(program) = arguments.program.first() {
        ensure!(Path::new(program).is_file(), "there is no program {program}");
    }
    let system = System::prepare()?;
    let initramfs = match &arguments.program[..] {
        [] => system.with_sessions(),
        [program, arguments @ ..] => system.with_program(Path::new(program), arguments),
    }?;
    let mut network = network()?;
    let listener = TcpListener::bind("127.0.0.1:0").context("cannot listen on this computer")?;
    let address = listener.local_addr()?;

    println!("starting Linux ({} s) ...", started.elapsed().as_secs());
    let serial_numbers: Vec<String> =
        (0..BOARDS).map(|number| format!("{:08X}", boards::serial_number(number))).collect();
    let mut qemu = Command::new(system::QEMU);
    qemu.args(["-accel", "tcg", "-m", "512", "-nodefaults", "-display", "none", "-no-reboot"])
        .arg("-kernel")
        .arg(system.kernel())
        .arg("-initrd")
        .arg(initramfs)
        .arg("-append")
        .arg(format!(
            "console=ttyS0 quiet panic=-1 serial_numbers=\"{}\"",
            serial_numbers.join(" ")
        ))
        .args(["-serial", "stdio", "-serial", &format!("tcp:{address}")])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped());
    let (sender, inputs) = mpsc::sync_channel(client::WAITING);
    client::accept(listener, sender.clone());
    let mut guest = Guest(qemu.spawn().context(format!("cannot run {}", system::QEMU))?);
    let outcome = thread::spawn(move || {
        let outcome = guest.converse(&sender);
        // The emulation may have failed; then it has ended.
        let _ = sender.send(Input::Stop);
        outcome
    });
    emulate::serve(&mut network, &inputs, &mut Surroundings::default(), DEFAULT_BIT_RATE)?;
    outcome.join().expect("it does not panic")?;
    for (number, board) in network.boards().iter().enumerate() {
        if let Some(finding) = board.findings().first() {
            bail!("board {number}: {finding}");
        }
    }
    println!("As expected, after {} s.", started.elapsed().as_secs());
    Ok(())
}

/// The blank boards, after their first start.
fn network() -> anyhow::Result<Network> {
    let image = image::build(PART)?;
    let mut network = Network::new();
    network.record(Recording::Off);
    for number in 0..BOARDS {
        network.add_board(boards::board(PART, &image, number));
    }
    network.run_for(FIRST_START);
    for number in POWERED..BOARDS {
        network.power_off(number);
    }
    Ok(network)
}

/// QEMU, which ends with this value.
struct Guest(Child);

impl Drop for Guest {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Guest {
    /// Prints what Linux says, and passes its commands on, until it ends.
    fn converse(&mut self, emulation: &SyncSender<Input>) -> anyhow::Result<()> {
        let mut keyboard = self.0.stdin.take().context("it is piped")?;
        let output = BufReader::new(self.0.stdout.take().context("it is piped")?);
        let (sender, lines) = mpsc::channel();
        thread::spawn(move || {
            output.split(b'\n').map_while(Result::ok).try_for_each(|line| sender.send(line))
        });
        // A `println!` that fails would end the program, but not QEMU.
        let mut out = io::stdout();
        let mut epoch = None;
        loop {
            let line = match lines.recv_timeout(SILENCE) {
                Ok(line) => String::from_utf8_lossy(&line).trim_end().to_owned(),
                Err(RecvTimeoutError::Timeout) => {
                    bail!("Linux has printed nothing for {} s", SILENCE.as_secs())
                }
                Err(RecvTimeoutError::Disconnected) => bail!("Linux ended in the middle"),
            };
            if let Some(command) = line.strip_prefix(TO_HOST) {
                if let Some(status) = command.strip_prefix("end ") {
                    ensure!(status == "0", "not as expected: exit status {status}, see above");
                    return Ok(());
                }
                emulation.send(Input::Console(command.to_owned()))?;
                writeln!(out, "host: {command}")?;
                keyboard.write_all(b"\n").ok().context("Linux ended in the middle")?;
            } else if let Some((time, frame)) = candump(&line) {
                let ms = 1e3 * (time - *epoch.get_or_insert(time));
                writeln!(out, "{ms:>12.3}   {}", describe(&frame))?;
            } else if !line.is_empty() {
                writeln!(out, "{line}")?;
            }
        }
    }
}

/// A line of `candump -L`, such as `(1795313000.062011) slcan0 7E5#0401000000000000`: the time in seconds and the frame.
fn candump(line: &str) -> Option<(f64, Frame)> {
    let [time, _, frame] = line.split(' ').collect::<Vec<_>>().try_into().ok()?;
    let time = time.strip_prefix('(')?.strip_suffix(')')?.parse().ok()?;
    let (id, data) = frame.split_once('#')?;
    let id = u16::from_str_radix(id, 16).ok().filter(|number| id.len() == 3 && *number <= 0x7FF)?;
    let byte = |at| u8::from_str_radix(data.get(at..at + 2)?, 16).ok();
    let data: Option<Vec<u8>> = (0..data.len().min(16)).step_by(2).map(byte).collect();
    Some((time, Frame::data(Id::Standard(id), &data?)))
}

fn describe(frame: &Frame) -> String {
    let data: Vec<String> = frame.payload().iter().map(|byte| format!("{byte:02X}")).collect();
    format!("{}  {:24} {}", frame.id, data.join(" "), explain(frame))
}
