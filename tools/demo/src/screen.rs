//! The printed session: chapters, each with the events of the bus, line by line.

use std::io::{self, Write};

use anstyle::{AnsiColor, Style};
use emulator::{
    can::{Frame, Id},
    network::{Event, Source, What},
};
use lss_slave::lss::{self, AddressPart, FastscanStep, Request};

use can_bus::explain::wrapped;
use testkit::explain::explain;

const CHAPTER: Style = Style::new().bold();
const MASTER: Style = AnsiColor::Cyan.on_default();
const BOARD: Style = AnsiColor::Green.on_default();
const ERROR: Style = AnsiColor::Red.on_default();
const REMARK: Style = AnsiColor::Yellow.on_default();
const DIM: Style = Style::new().dimmed();

/// The number of lines shown at the start of each part of a Fastscan, and at its end.
const SHOWN: usize = 4;

/// The column of a meaning.
const MEANING: usize = 45;

/// Prints to standard output, in colour if it is a terminal that supports it.
pub struct Screen {
    shows_all: bool,
    /// The number of events already shown or skipped.
    seen: usize,
    chapters: usize,
}

/// A line of output, and the part of a Fastscan that it belongs to.
struct Line {
    style: Style,
    text: String,
    /// The part of the LSS address scanned by this step, or confirmed by this answer.
    scanned: Option<AddressPart>,
}

impl Screen {
    /// A screen that shows every line of a Fastscan if `shows_all`, otherwise only the ends of its parts.
    pub fn new(shows_all: bool) -> Self {
        Self { shows_all, seen: 0, chapters: 0 }
    }

    /// Prints a headline.
    pub fn chapter(&mut self, headline: &str) -> anyhow::Result<()> {
        let mut out = anstream::stdout().lock();
        if self.chapters == 0 {
            writeln!(out, "{DIM}{:>8} {:<7} {:<3} {:<23} meaning{DIM:#}", "ms", "", "id", "data")?;
        }
        self.chapters += 1;
        Ok(writeln!(out, "\n{CHAPTER}{}{CHAPTER:#}", wrapped(headline, 0))?)
    }

    /// Prints text that is not an event.
    pub fn remark(&self, text: &str) -> anyhow::Result<()> {
        Ok(writeln!(anstream::stdout(), "{REMARK}{}{REMARK:#}", wrapped(text, 0))?)
    }

    /// Prints the events since the last call; `events` holds the earlier ones too.
    pub fn show(&mut self, events: &[Event]) -> anyhow::Result<()> {
        let mut lines: Vec<Line> = Vec::new();
        for event in &events[self.seen..] {
            let before = lines.last().and_then(|line| line.scanned);
            lines.extend(line(event, before));
        }
        self.seen = events.len();
        Ok(self.print(&lines)?)
    }

    fn print(&self, lines: &[Line]) -> io::Result<()> {
        let mut out = anstream::stdout().lock();
        for part in lines.chunk_by(|a, b| a.scanned == b.scanned) {
            let is_folded =
                part[0].scanned.is_some() && part.len() > 2 * SHOWN + 1 && !self.shows_all;
            let folded = if is_folded { SHOWN..part.len() - SHOWN } else { 0..0 };
            for (at, Line { style, text, .. }) in part.iter().enumerate() {
                if !folded.contains(&at) {
                    writeln!(out, "{style}{text}{style:#}")?;
                } else if at == folded.start {
                    let count = folded.len();
                    writeln!(out, "{DIM}{:>8} {count} more frames, bit by bit{DIM:#}", "...")?;
                }
            }
        }
        out.flush()
    }
}

/// Whether several boards sent the same frame at the same time.
fn is_of_several(event: &Event) -> bool {
    matches!(&event.what, What::Frame { also, .. } if !also.is_empty())
}

/// The line of an event, if it is of interest; `before` is the part scanned by the line before.
fn line(event: &Event, before: Option<AddressPart>) -> Option<Line> {
    let (style, who) = match event.source {
        Source::Adapter(_) => (MASTER, "master".to_owned()),
        Source::Board(_) if is_of_several(event) => (BOARD, "boards".to_owned()),
        Source::Board(number) => (BOARD, format!("board {number}")),
    };
    let plain = |text: String| Some((style, text, None));
    let (style, text, scanned) = match &event.what {
        What::Frame { frame, .. } => {
            let scanned = match event.source {
                Source::Adapter(_) => scanned_part(frame),
                Source::Board(_) => before,
            };
            let bytes: Vec<_> = frame.payload().iter().map(|byte| format!("{byte:02X}")).collect();
            let (id, bytes) = (frame.id.to_string(), bytes.join(" "));
            let meaning = explain(frame);
            // The COB-ID says so.
            let meaning = meaning.strip_prefix("LSS ").unwrap_or(&meaning);
            let text = format!("{id:<3} {bytes:<23} {meaning}");
            Some((style, text, scanned))
        }
        What::Error { kind, .. } => Some((ERROR, format!("error frame: {kind:?}"), None)),
        What::BusOff => Some((ERROR, "bus-off".into(), None)),
        What::Recovered => plain("has recovered from bus-off".into()),
        What::BitTiming { bit_rate, .. } => {
            plain(format!("sets its bit rate: {} kbit/s", bit_rate / 1000))
        }
        What::Reset(cause) => plain(format!("is reset: {cause:?}")),
        What::PowerOff => plain("has no power".into()),
        What::PowerOn => plain("has power".into()),
        What::Requested { .. }
        | What::Aborted { .. }
        | What::InitializationEntered
        | What::InitializationLeft => None,
    }?;
    let milliseconds = event.time.as_us() as f64 / 1000.0;
    let text = wrapped(&format!("{milliseconds:>8.3} {who:<7} {text}"), MEANING);
    Some(Line { style, text, scanned })
}

/// The part scanned by the Fastscan step in `frame`, if it is one that tests bits.
fn scanned_part(frame: &Frame) -> Option<AddressPart> {
    if frame.id != Id::Standard(lss::REQUEST_COB_ID) {
        return None;
    }
    match Request::from_bytes(&frame.data)? {
        Request::Fastscan(FastscanStep { sub, bit_check: 0..32, .. }) => AddressPart::new(sub),
        _ => None,
    }
}
