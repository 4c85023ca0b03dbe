//! A line on the terminal that says what takes so long.

use std::{
    io::{self, Write},
    time::{Duration, Instant},
};

/// The time after which a command says what it does.
const PATIENCE: Duration = Duration::from_secs(1);
/// The time between two changes of the line.
const INTERVAL: Duration = Duration::from_millis(100);

/// The line, if there is a terminal.
pub struct Progress {
    is_shown: bool,
    next: Instant,
    is_drawn: bool,
}

impl Progress {
    pub fn new(is_shown: bool) -> Self {
        Self { is_shown, next: Instant::now() + PATIENCE, is_drawn: false }
    }

    /// Says what is being done.
    pub fn say(&mut self, what: impl FnOnce() -> String) {
        let now = Instant::now();
        if self.is_shown && now >= self.next {
            // Without a terminal there is nobody to read it.
            let _ = write!(io::stderr(), "\r\x1B[K{}", what());
            self.next = now + INTERVAL;
            self.is_drawn = true;
        }
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
