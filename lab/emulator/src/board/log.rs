//! The program's log as it is in RAM: what a debug probe fetches from its RTT buffer.

use crate::{Time, engine::Engine, image::Image};

/// A part of a log, in the order of the parts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Logged {
    /// These bytes were fetched at this time, at most one poll interval after the last of them was written.
    Bytes(Time, Vec<u8>),
    /// The program began again: what it had not completed is lost.
    Restart,
}

/// The up channel 0 of a SEGGER RTT control block.
#[derive(Debug)]
pub struct Log {
    control_block: Option<u32>,
    logged: Vec<Logged>,
}

/// Offset of the up channel behind the id and the two channel counts.
const CHANNEL: u32 = 24;

impl Log {
    pub fn new(image: &Image) -> Self {
        Self { control_block: image.symbol("_SEGGER_RTT"), logged: Vec::new() }
    }

    pub fn logged(&self) -> &[Logged] {
        &self.logged
    }

    /// Fetches the data written since the last poll and frees the buffer.
    pub fn poll(&mut self, engine: &mut dyn Engine) {
        let Some(block) = self.control_block else {
            return;
        };
        let mut id = [0; 16];
        // Before the program has initialised its data, RAM has random content.
        if !engine.read_memory(block, &mut id) || !id.starts_with(b"SEGGER RTT") {
            return;
        }
        let mut channel = [0; 20];
        if !engine.read_memory(block + CHANNEL, &mut channel) {
            return;
        }
        let (words, _) = channel.as_chunks();
        let [_, buffer, size, write, read] =
            std::array::from_fn(|at| u32::from_le_bytes(words[at]));
        if read == write || read >= size || write >= size {
            return;
        }
        let mut bytes = vec![0; size as usize];
        if !engine.read_memory(buffer, &mut bytes) {
            return;
        }
        engine.write_memory(block + CHANNEL + 16, &write.to_le_bytes());
        let (read, write) = (read as usize, write as usize);
        let new = if read < write {
            bytes[read..write].to_vec()
        } else {
            [&bytes[read..], &bytes[..write]].concat()
        };
        self.logged.push(Logged::Bytes(engine.now(), new));
    }

    /// Hides the buffer until the program has initialised its data again: until then its pointers belong together by
    /// chance only.
    pub fn restart(&mut self, engine: &mut dyn Engine) {
        if let Some(block) = self.control_block {
            self.logged.push(Logged::Restart);
            engine.write_memory(block + CHANNEL + 12, &[0; 8]);
        }
    }
}
