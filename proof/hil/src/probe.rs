//! A debug probe, by the program `probe-rs`.

use std::{
    io::{self, Read},
    process::{Command, Stdio},
    thread,
    time::{Duration, Instant},
};

use anyhow::{Context, ensure};
use canopen_stm32f4::chip::{CHIPS, Chip, sysclk_hz};

/// The longest run of `probe-rs`.
const LIMIT: Duration = Duration::from_secs(20);

/// The probe of the first board.
pub struct Probe {
    pub chip: Chip,
    /// The CAN controller on the bus, 1 for CAN1.
    pub controller: u8,
}

impl Probe {
    /// The features of the chips with the clocks of the emulated board.
    pub fn chips() -> impl Iterator<Item = &'static str> {
        let has_its_clocks = |chip: &&Chip| sysclk_hz(chip) == 160_000_000;
        const { &CHIPS }.iter().filter(has_its_clocks).map(|chip| chip.feature)
    }

    /// The probe of a board with this chip and this CAN controller on the bus.
    ///
    /// # Errors
    /// The firmware does not know the chip, or it does not have the controller.
    pub fn new(chip: &str, controller: u8) -> anyhow::Result<Self> {
        let chip = Chip::named(chip).context("an unknown chip")?;
        ensure!(
            u32::from(controller) <= chip.controllers,
            "{} has no CAN{controller}",
            chip.feature
        );
        Ok(Self { chip, controller })
    }

    /// Reads a word without halting the core.
    pub fn read(&self, address: u32) -> Result<u32, String> {
        let output = self.run(&[
            "read",
            "--chip",
            self.chip.probe_rs,
            "b32",
            &format!("{address:#X}"),
            "1",
        ])?;
        let words = output.split_whitespace().rev();
        let value = words
            .filter(|word| word.len() == 8)
            .find_map(|word| u32::from_str_radix(word, 16).ok());
        value.ok_or_else(|| format!("probe-rs read prints {output:?} instead of a word"))
    }

    /// Resets the board by its reset line or the debug port.
    pub fn reset(&self) -> Result<(), String> {
        self.run(&["reset", "--chip", self.chip.probe_rs]).map(drop)
    }

    fn run(&self, arguments: &[&str]) -> Result<String, String> {
        let mut command = Command::new("probe-rs");
        command.args(arguments).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => {
                "probe-rs is missing: `cargo install probe-rs-tools --locked`".to_owned()
            }
            _ => format!("cannot run probe-rs: {error}"),
        })?;
        let until = Instant::now() + LIMIT;
        let status = loop {
            match child.try_wait() {
                Ok(Some(status)) => break status,
                Ok(None) if Instant::now() < until => thread::sleep(Duration::from_millis(20)),
                _ => {
                    // It is over in any case.
                    let _ = child.kill();
                    let _ = child.wait();
                    return Err(format!("probe-rs did not end in {} s", LIMIT.as_secs()));
                }
            }
        };
        let text = |pipe: Option<&mut dyn Read>| {
            let mut bytes = Vec::new();
            if let Some(pipe) = pipe {
                // What was read until an error is enough for a person.
                let _ = pipe.read_to_end(&mut bytes);
            }
            String::from_utf8_lossy(&bytes).trim().to_owned()
        };
        if status.success() {
            return Ok(text(child.stdout.as_mut().map(|pipe| pipe as &mut dyn Read)));
        }
        let why = text(child.stderr.as_mut().map(|pipe| pipe as &mut dyn Read));
        Err(format!(
            "probe-rs fails: {why}. If it cannot connect to a core that sleeps: docs/first-board.md, \"When the probe \
             cannot connect\""
        ))
    }
}
