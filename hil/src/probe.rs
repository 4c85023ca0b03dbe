//! A debug probe, by the program `probe-rs`.

use std::{
    io::{self, Read},
    process::{Command, Stdio},
    thread,
    time::{Duration, Instant},
};

/// The longest run of `probe-rs`.
const LIMIT: Duration = Duration::from_secs(20);

/// The probe of the first board.
pub struct Probe {
    /// The name of the chip in probe-rs.
    chip: &'static str,
}

impl Probe {
    /// The chips of this firmware, and their names in probe-rs; the package makes no difference.
    pub const CHIPS: [(&str, &str); 4] = [
        ("stm32f405", "STM32F405RGTx"),
        ("stm32f407", "STM32F407VGTx"),
        ("stm32f427", "STM32F427VITx"),
        ("stm32f446", "STM32F446RETx"),
    ];

    /// The probe of a board with this chip; `None` for a chip that the firmware does not know.
    pub fn new(chip: &str) -> Option<Self> {
        let (_, chip) = Self::CHIPS.into_iter().find(|(name, _)| *name == chip)?;
        Some(Self { chip })
    }

    /// Reads a word without halting the core.
    pub fn read(&self, address: u32) -> Result<u32, String> {
        let output =
            self.run(&["read", "--chip", self.chip, "b32", &format!("{address:#X}"), "1"])?;
        let words = output.split_whitespace().rev();
        let value = words
            .filter(|word| word.len() == 8)
            .find_map(|word| u32::from_str_radix(word, 16).ok());
        value.ok_or_else(|| format!("probe-rs read prints {output:?} instead of a word"))
    }

    /// Resets the board by its reset line or the debug port.
    pub fn reset(&self) -> Result<(), String> {
        self.run(&["reset", "--chip", self.chip]).map(drop)
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
