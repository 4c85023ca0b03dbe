//! Questions to the person at the bench, with bounded waits.

use std::{
    io,
    sync::mpsc::{self, Receiver, RecvTimeoutError},
    thread,
    time::{Duration, Instant},
};

/// The wait for an answer of the person.
const PATIENCE: Duration = Duration::from_secs(120);

/// The person, if there is one.
pub struct Person(Option<Receiver<String>>);

impl Person {
    /// A person who answers on the standard input.
    pub fn at_standard_input() -> Self {
        let (sender, lines) = mpsc::channel();
        thread::spawn(move || {
            for line in io::stdin().lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        Self(Some(lines))
    }

    /// Nobody, who agrees to nothing.
    pub fn absent() -> Self {
        Self(None)
    }

    /// Asks whether the person agrees; `is_over` ends the wait.
    pub fn agrees(&self, question: &str, is_over: impl Fn() -> bool) -> bool {
        let Some(lines) = &self.0 else { return false };
        println!("  ?       {question} [y = yes, Enter = no]");
        let until = Instant::now() + PATIENCE;
        loop {
            match lines.recv_timeout(Duration::from_millis(100)) {
                Ok(line) => return line.trim().eq_ignore_ascii_case("y"),
                Err(RecvTimeoutError::Disconnected) => return false,
                Err(RecvTimeoutError::Timeout) if Instant::now() < until && !is_over() => {}
                Err(RecvTimeoutError::Timeout) => return false,
            }
        }
    }
}
