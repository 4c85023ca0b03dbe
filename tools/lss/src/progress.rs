//! A line on the terminal that says what takes so long.

use std::{
    io::{self, Write},
    time::{Duration, Instant},
};

/// The time after which a command says what it does.
const PATIENCE: Duration = Duration::from_secs(1);
/// The time between two changes of the line.
const INTERVAL: Duration = Duration::from_millis(100);

/// The same for a line of its own, where lines cannot change.
const PIPE_INTERVAL: Duration = Duration::from_secs(5);

/// Where the line goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shows {
    /// It changes on the terminal.
    Line,
    /// Now and then another one goes to a file, a pipe or a terminal that cannot clear one.
    Lines,
    Nothing,
}

/// The line.
pub struct Progress {
    shows: Shows,
    next: Instant,
    is_drawn: bool,
}

impl Progress {
    pub fn new(shows: Shows) -> Self {
        let patience = if shows == Shows::Line { PATIENCE } else { PIPE_INTERVAL };
        Self { shows, next: Instant::now() + patience, is_drawn: false }
    }

    /// Says what is being done.
    pub fn say(&mut self, what: impl FnOnce() -> String) {
        let now = Instant::now();
        if now < self.next {
            return;
        }
        // There may be nobody to read it.
        let _ = match self.shows {
            Shows::Line => write!(io::stderr(), "\r\x1B[K{}", what()),
            Shows::Lines => writeln!(io::stderr(), "{}", what()),
            Shows::Nothing => return,
        };
        self.is_drawn = self.shows == Shows::Line;
        self.next = now + if self.is_drawn { INTERVAL } else { PIPE_INTERVAL };
    }

    /// Says something that stays, on the standard error.
    pub fn note(&mut self, words: &str) {
        self.clear();
        eprintln!("{words}");
    }

    /// Clears the line.
    pub fn clear(&mut self) {
        if self.is_drawn {
            let _ = write!(io::stderr(), "\r\x1B[K");
            self.is_drawn = false;
        }
    }
}
