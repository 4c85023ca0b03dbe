//! Decodes the logs of emulated boards: defmt frames, or lines of text.

use defmt_decoder::{DecodeError, Table};
use emulator::{
    Time,
    board::{Board, Logged},
    image::Image,
};

/// A decoded message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LogLine {
    /// The time at which it was fetched.
    pub time: Time,
    /// `trace`, `debug`, `info`, `warn` or `error`; empty for `println` and for plain text.
    pub level: &'static str,
    pub text: String,
}

/// The lines that the program on the board has logged, across all resets.
///
/// # Panics
/// The program has a defmt section of another version than the decoder's.
pub fn lines(board: &Board) -> Vec<LogLine> {
    Decoder::new(board.image()).expect("a log of the decoder's version").new_lines(board)
}

/// Decodes the log of a board piece by piece.
pub struct Decoder {
    /// The defmt strings, if the program has any.
    table: Option<Table>,
    /// The number of parts that are decoded.
    position: usize,
    frame: Vec<u8>,
}

impl Decoder {
    /// A decoder for boards with this program.
    ///
    /// # Errors
    /// The program has a defmt section of another version than the decoder's.
    pub fn new(image: &Image) -> anyhow::Result<Self> {
        let table = if image.elf().is_empty() { None } else { Table::parse(image.elf())? };
        Ok(Self { table, position: 0, frame: Vec::new() })
    }

    /// The lines since the last call.
    pub fn new_lines(&mut self, board: &Board) -> Vec<LogLine> {
        let mut lines = Vec::new();
        let logged = board.logged();
        for part in &logged[self.position..] {
            match part {
                Logged::Bytes(time, bytes) => lines.extend(bytes.iter().filter_map(|byte| {
                    let (level, text) = self.push(*byte)?;
                    Some(LogLine { time: *time, level, text })
                })),
                Logged::Restart => self.frame.clear(),
            }
        }
        self.position = logged.len();
        lines
    }

    /// Takes a byte. Returns the level and the text of the message that it completes.
    fn push(&mut self, byte: u8) -> Option<(&'static str, String)> {
        self.frame.push(byte);
        let Some(table) = &self.table else {
            if byte != b'\n' {
                return None;
            }
            let text = String::from_utf8_lossy(&self.frame).trim_end().to_owned();
            self.frame.clear();
            return Some(("", text));
        };
        // With rzCOBS a zero byte ends a frame.
        if table.encoding().can_recover() && byte != 0 {
            return None;
        }
        let mut decoder = table.new_stream_decoder();
        decoder.received(&self.frame);
        let (level, text) = match decoder.decode() {
            Ok(frame) => (
                frame.level().map_or("", |level| level.as_str()),
                frame.display_message().to_string(),
            ),
            Err(DecodeError::UnexpectedEof) if byte != 0 => return None,
            Err(DecodeError::UnexpectedEof) => ("", String::new()),
            Err(DecodeError::Malformed) => {
                ("error", format!("malformed defmt frame {:02x?}", self.frame))
            }
        };
        self.frame.clear();
        (!text.is_empty()).then_some((level, text))
    }
}
