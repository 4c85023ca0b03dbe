//! What loader, program and start leave each other in the last 32 bytes of RAM, which keep their content in a reset.

use crate::crc;

/// "MAIL", so that a RAM of zeros is no mailbox.
const MAGIC: u32 = u32::from_le_bytes(*b"MAIL");

/// What the sender wants of the next start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Command {
    /// Nothing: start as the journal says.
    #[default]
    Start,
    /// 1F51h = 0: stay in the loader, which owes the client the answer to this request.
    Stop,
}

/// What was started last.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Started {
    /// The loader.
    #[default]
    Loader,
    /// A program that is not on trial.
    Program,
    /// A program on trial.
    Trial,
}

/// The content of the mailbox.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Mailbox {
    /// What the sender wants of the next start.
    pub command: Command,
    /// What was started last.
    pub started: Started,
    /// The starts in a row that a watchdog or a fault has ended within 60 s.
    pub failures: u8,
    /// The node-ID in force; 0 without one.
    pub node_id: u8,
    /// The heartbeat time in force, in milliseconds.
    pub heartbeat_ms: u16,
    /// The bit rate in force, in kbit/s; 0 if it is not known.
    pub kbit: u16,
}

impl Mailbox {
    /// The 32 bytes of RAM.
    #[must_use]
    pub fn to_words(&self) -> [u32; 8] {
        let states = [
            matches!(self.command, Command::Stop) as u8,
            match self.started {
                Started::Loader => 0,
                Started::Program => 1,
                Started::Trial => 2,
            },
            self.failures,
            self.node_id,
        ];
        let times = u32::from(self.heartbeat_ms) | u32::from(self.kbit) << 16;
        let content = [MAGIC, u32::from_le_bytes(states), times, 0, 0, 0, 0];
        let [a, b, c, d, e, f, g] = content;
        [a, b, c, d, e, f, g, crc_of(&content)]
    }

    /// The content of the 32 bytes; `None` if they are no mailbox, as after a power-on.
    pub fn from_words(words: &[u32; 8]) -> Option<Self> {
        let [a, b, c, d, e, f, g, crc] = *words;
        if a != MAGIC || crc != crc_of(&[a, b, c, d, e, f, g]) {
            return None;
        }
        let [command, started, failures, node_id] = b.to_le_bytes();
        Some(Self {
            command: if command == 1 { Command::Stop } else { Command::Start },
            started: match started {
                1 => Started::Program,
                2 => Started::Trial,
                _ => Started::Loader,
            },
            failures,
            node_id,
            heartbeat_ms: c as u16,
            kbit: (c >> 16) as u16,
        })
    }
}

fn crc_of(words: &[u32; 7]) -> u32 {
    !words.iter().fold(crc::BEGIN, |crc, word| crc::more(crc, &word.to_le_bytes()))
}
