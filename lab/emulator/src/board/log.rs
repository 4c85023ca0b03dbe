//! The program's log: defmt frames, or lines of text, fetched from the RTT buffer in RAM as a debug probe does.

use defmt_decoder::DecodeError;

use crate::{Time, engine::Engine, image::Image};

/// A decoded log message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LogLine {
    /// The time at which it was fetched, at most one poll interval after it was written.
    pub time: Time,
    /// `trace`, `debug`, `info`, `warn` or `error`; empty for `println` and for plain text.
    pub level: &'static str,
    pub text: String,
}

/// The up channel 0 of a SEGGER RTT control block.
#[derive(Debug)]
pub struct Log {
    image: Image,
    control_block: Option<u32>,
    frame: Vec<u8>,
    lines: Vec<LogLine>,
}

/// Offset of the up channel behind the id and the two channel counts.
const CHANNEL: u32 = 24;

impl Log {
    pub fn new(image: Image) -> Self {
        let control_block = image.symbol("_SEGGER_RTT");
        Self { image, control_block, frame: Vec::new(), lines: Vec::new() }
    }

    pub fn lines(&self) -> &[LogLine] {
        &self.lines
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
        let now = engine.now();
        let mut position = read;
        while position != write {
            self.push(bytes[position as usize], now);
            position = (position + 1) % size;
        }
    }

    /// Discards a frame that was cut off by the end of the program, and hides the buffer until the program has
    /// initialised its data again: until then its pointers belong together by chance only.
    pub fn restart(&mut self, engine: &mut dyn Engine) {
        self.frame.clear();
        if let Some(block) = self.control_block {
            engine.write_memory(block + CHANNEL + 12, &[0; 8]);
        }
    }

    fn push(&mut self, byte: u8, now: Time) {
        self.frame.push(byte);
        let Some(table) = self.image.defmt_table() else {
            if byte == b'\n' {
                let text = String::from_utf8_lossy(&self.frame).trim_end().to_owned();
                self.lines.push(LogLine { time: now, level: "", text });
                self.frame.clear();
            }
            return;
        };
        // With rzCOBS a zero byte ends a frame.
        if table.encoding().can_recover() && byte != 0 {
            return;
        }
        let mut decoder = table.new_stream_decoder();
        decoder.received(&self.frame);
        let (level, text) = match decoder.decode() {
            Ok(frame) => (
                frame.level().map_or("", |level| level.as_str()),
                frame.display_message().to_string(),
            ),
            Err(DecodeError::UnexpectedEof) if byte != 0 => return,
            Err(DecodeError::UnexpectedEof) => ("", String::new()),
            Err(DecodeError::Malformed) => {
                ("error", format!("malformed defmt frame {:02x?}", self.frame))
            }
        };
        if !text.is_empty() {
            self.lines.push(LogLine { time: now, level, text });
        }
        self.frame.clear();
    }
}
