//! The text of a data sheet: its encoding, its lines, and what of them cannot be read.

use std::{fmt, fs, io, io::Read, path::Path};

/// The longest file that is read, in bytes; the data sheets of vendors have up to a few MB.
const LONGEST: u64 = 64 << 20;

/// What of a data sheet cannot be read.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Fault {
    /// From 1 on; that of the header, if a section as a whole cannot be read.
    pub line: usize,
    /// The name of the section, as [`super::Eds::section`] takes it; empty: it stands in none.
    pub section: String,
    /// The key that has two values, in lower case.
    pub twice: Option<String>,
    /// Why, in words.
    pub words: String,
    /// With it a value is lost that a device is to have.
    pub is_wanted: bool,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &*self.section {
            "" => write!(f, "line {}: {}", self.line, self.words),
            section => write!(f, "line {}, [{section}]: {}", self.line, self.words),
        }
    }
}

/// A line of a data sheet.
pub enum Line<'a> {
    /// There is nothing on it, or a comment.
    Empty,
    Section(&'a str),
    Key(&'a str, &'a str),
    Unread,
}

impl<'a> Line<'a> {
    /// Reads a line. Comments begin with `;` or `#`, behind a value with a blank and `;`: a text may be `Input #1`.
    pub fn read(line: &'a str) -> Self {
        let line = trim(line);
        if line.is_empty() || line.starts_with([';', '#']) {
            return Self::Empty;
        }
        if let Some(section) = line.strip_prefix('[') {
            return match section.split_once(']') {
                Some((name, rest)) if matches!(Self::read(rest), Self::Empty) => {
                    Self::Section(trim(name))
                }
                _ => Self::Unread,
            };
        }
        let Some((key, value)) = line.split_once('=') else { return Self::Unread };
        let is_comment = |(at, _): &(usize, &str)| value[..*at].trim_end().len() < *at || *at == 0;
        let end = value.match_indices(';').find(is_comment).map_or(value.len(), |(at, _)| at);
        Self::Key(trim(key), trim(&value[..end]))
    }
}

/// Without blanks and what some programs put beside lines: zeros, marks of the end of a file or of a byte order.
fn trim(text: &str) -> &str {
    text.trim_matches(|c: char| c.is_whitespace() || c.is_control() || c == '\u{FEFF}')
}

/// A number, or another word without spaces in it: without a comment, which may follow at once, and without quotes.
pub fn word(text: &str) -> &str {
    let text = trim(text.split([';', '#']).next().unwrap_or_default());
    trim(text.strip_prefix('"').and_then(|text| text.strip_suffix('"')).unwrap_or(text))
}

/// The text of a file with one kind of line ends, and whether it is in Latin-1.
pub fn read(path: &Path) -> io::Result<(String, bool)> {
    let mut bytes = Vec::new();
    fs::File::open(path)?.take(LONGEST + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > LONGEST {
        return Err(io::Error::other("more than 64 MB are no data sheet"));
    }
    let (text, is_latin) = decode(&bytes);
    Ok((text.replace("\r\n", "\n").replace('\r', "\n"), is_latin))
}

/// A text in UTF-16, UTF-8, or else in Latin-1, which is told.
pub fn decode(bytes: &[u8]) -> (String, bool) {
    let units = |unit: fn([u8; 2]) -> u16| {
        let pairs = bytes.chunks_exact(2).map(|pair| unit([pair[0], pair[1]]));
        let text: String =
            char::decode_utf16(pairs).map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER)).collect();
        (text.trim_start_matches('\u{FEFF}').to_owned(), false)
    };
    match (bytes, str::from_utf8(bytes)) {
        // Some files have no mark of the byte order, but begin with a section or a comment.
        ([0xFF, 0xFE, ..] | [b'[' | b';', 0, ..], _) => units(u16::from_le_bytes),
        ([0xFE, 0xFF, ..] | [0, b'[' | b';', ..], _) => units(u16::from_be_bytes),
        (_, Ok(text)) => (text.trim_start_matches('\u{FEFF}').to_owned(), false),
        (_, Err(_)) => (bytes.iter().copied().map(char::from).collect(), true),
    }
}

/// The bytes of a text from a file.
pub fn encode(text: &str, is_latin: bool) -> Vec<u8> {
    let latin: Option<Vec<u8>> = text.chars().map(|c| u8::try_from(c).ok()).collect();
    latin.filter(|_| is_latin).unwrap_or_else(|| text.as_bytes().to_vec())
}
