//! What we need of GDB's remote protocol to drive QEMU's core instruction by instruction.

use std::{
    io::{self, BufRead, BufReader, Write},
    process::{Child, ChildStdin, Command, Stdio},
    sync::mpsc::{Receiver, RecvTimeoutError, sync_channel},
    thread,
    time::Duration,
};

use anyhow::{Context, bail, ensure};

/// GDB's numbers of the registers (QEMU's `arm-m-profile.xml` and `arm-vfp.xml`).
const XPSR: usize = 25;
const D0: usize = 26;
const FPSCR: usize = D0 + 16;
/// Bytes that fit into a packet of QEMU's, 4096 characters.
const CHUNK: usize = 1024;
/// QEMU answers within a millisecond, unless its program runs past what it was to stop at.
const PATIENCE: Duration = Duration::from_secs(20);

/// A QEMU that stands still; it ends with this.
pub struct Gdb {
    qemu: Child,
    to: ChildStdin,
    answers: Receiver<String>,
}

impl Gdb {
    /// Starts QEMU, which has to offer its debugger on its standard input and output.
    pub fn start(command: &mut Command) -> anyhow::Result<Self> {
        let mut qemu = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let to = qemu.stdin.take().expect("its input is a pipe");
        let mut from = BufReader::new(qemu.stdout.take().expect("its output is a pipe"));
        let (sender, answers) = sync_channel(1);
        thread::spawn(move || {
            // It ends with QEMU or with us.
            while let Ok(answer) = read_packet(&mut from)
                && sender.send(answer).is_ok()
            {}
        });
        let mut gdb = Self { qemu, to, answers };
        // Without the description QEMU speaks of registers as of another core's.
        gdb.ask("qXfer:features:read:target.xml:0,1000")?;
        // A step lets interrupts happen.
        gdb.order("Qqemu.sstep=0x1")?;
        // An access to memory is one by the bus: it reaches devices.
        gdb.order("Qqemu.PhyMemMode:1")?;
        Ok(gdb)
    }

    /// Lets the core make a step: an instruction or an exception entry.
    pub fn step(&mut self) -> anyhow::Result<()> {
        self.go("s")
    }

    /// Lets the core run until it is about to execute the instruction at `address` for the `times`th time, not counting
    /// the one that is next now.
    pub fn run_to(&mut self, address: u32, times: usize) -> anyhow::Result<()> {
        self.order(&format!("Z0,{address:x},2"))?;
        for _ in 0..times {
            // A step ignores breakpoints, such as that from which it goes on.
            self.go("s")?;
            self.go("c")?;
        }
        self.order(&format!("z0,{address:x},2"))
    }

    fn go(&mut self, packet: &str) -> anyhow::Result<()> {
        let answer = self.ask(packet)?;
        ensure!(answer.starts_with('T'), "QEMU answers `{packet}` with `{answer}`");
        Ok(())
    }

    /// `r0..r15` and the xPSR.
    pub fn registers(&mut self) -> anyhow::Result<([u32; 16], u32)> {
        let answer = self.ask("g")?;
        let words = words(&answer)?;
        let (r, rest) = words.split_first_chunk().context("QEMU has too few registers")?;
        Ok((*r, *rest.first().context("QEMU has no xPSR")?))
    }

    /// `s0..s31` and the FPSCR.
    pub fn fp_registers(&mut self) -> anyhow::Result<([u32; 32], u32)> {
        let mut s = [0; 32];
        for (number, pair) in s.chunks_mut(2).enumerate() {
            let answer = self.ask(&format!("p{:x}", D0 + number))?;
            pair.copy_from_slice(words(&answer)?.get(..2).context("QEMU has no d registers")?);
        }
        let fpscr = words(&self.ask(&format!("p{FPSCR:x}"))?)?;
        Ok((s, *fpscr.first().context("QEMU has no FPSCR")?))
    }

    /// Sets `r0..r15`.
    pub fn set_register(&mut self, number: usize, value: u32) -> anyhow::Result<()> {
        self.order(&format!("P{number:x}={:08x}", value.swap_bytes()))
    }

    /// Sets the xPSR.
    pub fn set_xpsr(&mut self, value: u32) -> anyhow::Result<()> {
        self.set_register(XPSR, value)
    }

    /// Loads, as the bus does.
    pub fn read(&mut self, address: u32, bytes: &mut [u8]) -> anyhow::Result<()> {
        for (address, chunk) in (address..).step_by(CHUNK).zip(bytes.chunks_mut(CHUNK)) {
            let answer = self.ask(&format!("m{address:x},{:x}", chunk.len()))?;
            let read = self::bytes(&answer)?;
            ensure!(read.len() == chunk.len(), "QEMU answers a load of {address:#x} with {answer}");
            chunk.copy_from_slice(&read);
        }
        Ok(())
    }

    /// Stores, as the bus does.
    pub fn write(&mut self, address: u32, bytes: &[u8]) -> anyhow::Result<()> {
        for (address, chunk) in (address..).step_by(CHUNK).zip(bytes.chunks(CHUNK)) {
            let data: String = chunk.iter().map(|byte| format!("{byte:02x}")).collect();
            self.order(&format!("M{address:x},{:x}:{data}", chunk.len()))?;
        }
        Ok(())
    }

    fn order(&mut self, packet: &str) -> anyhow::Result<()> {
        let answer = self.ask(packet)?;
        ensure!(answer == "OK", "QEMU answers `{packet:.40}` with `{answer}`: it may be too old");
        Ok(())
    }

    fn ask(&mut self, packet: &str) -> anyhow::Result<String> {
        let sum = packet.bytes().fold(0u8, u8::wrapping_add);
        let ended = "QEMU has ended: see above for what it says, if anything";
        // With the acknowledgement of the answer before.
        self.to.write_all(format!("+${packet}#{sum:02x}").as_bytes()).context(ended)?;
        self.to.flush().context(ended)?;
        match self.answers.recv_timeout(PATIENCE) {
            Ok(answer) => Ok(answer),
            Err(RecvTimeoutError::Disconnected) => bail!(ended),
            Err(RecvTimeoutError::Timeout) => bail!("QEMU does not come to where the emulator is"),
        }
    }
}

impl Drop for Gdb {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.qemu.kill();
        let _ = self.qemu.wait();
    }
}

fn read_packet(from: &mut impl BufRead) -> io::Result<String> {
    let mut packet = Vec::new();
    from.skip_until(b'$')?;
    from.read_until(b'#', &mut packet)?;
    from.read_exact(&mut [0; 2])?;
    packet.pop();
    Ok(String::from_utf8_lossy(&packet).into_owned())
}

fn bytes(hex: &str) -> anyhow::Result<Vec<u8>> {
    let byte = |pair: &[u8]| u8::from_str_radix(str::from_utf8(pair).ok()?, 16).ok();
    hex.as_bytes()
        .chunks(2)
        .map(byte)
        .collect::<Option<_>>()
        .with_context(|| format!("QEMU answers `{hex}`"))
}

fn words(hex: &str) -> anyhow::Result<Vec<u32>> {
    let word = |bytes: &[u8]| bytes.iter().rev().fold(0, |word, byte| word << 8 | u32::from(*byte));
    Ok(bytes(hex)?.chunks(4).map(word).collect())
}
