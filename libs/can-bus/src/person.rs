//! The person at the computer, who answers questions on the standard input.

use std::{
    cell::OnceCell,
    io,
    sync::mpsc::{self, Receiver, TryRecvError},
    thread,
    time::{Duration, Instant},
};

/// The wait for an answer of the person.
pub const PATIENCE: Duration = Duration::from_secs(120);
/// The time between two looks at the standard input.
const INTERVAL: Duration = Duration::from_millis(100);

/// The person, if there is one.
pub struct Person {
    is_present: bool,
    /// The lines that the person has written since the first question.
    lines: OnceCell<Receiver<String>>,
}

impl Person {
    /// A person who answers on the standard input.
    pub fn at_standard_input() -> Self {
        Self { is_present: true, lines: OnceCell::new() }
    }

    /// Nobody, who answers nothing.
    pub fn absent() -> Self {
        Self { is_present: false, lines: OnceCell::new() }
    }

    /// A person who answers these lines and no more.
    pub fn who_says(lines: &[&str]) -> Self {
        let (sender, receiver) = mpsc::channel();
        for line in lines {
            // The receiver exists.
            let _ = sender.send((*line).to_owned());
        }
        Self { is_present: true, lines: OnceCell::from(receiver) }
    }

    pub fn is_present(&self) -> bool {
        self.is_present
    }

    /// The next line of the person. `wait` lets a short time pass, and says whether to go on; its error ends the wait.
    pub fn answer<E>(
        &self,
        mut wait: impl FnMut() -> Result<bool, E>,
    ) -> Result<Option<String>, E> {
        if !self.is_present {
            return Ok(None);
        }
        let lines = self.lines.get_or_init(standard_input);
        loop {
            match lines.try_recv() {
                Ok(line) => return Ok(Some(line.trim().to_owned())),
                Err(TryRecvError::Disconnected) => return Ok(None),
                Err(TryRecvError::Empty) => {}
            }
            if !wait()? {
                return Ok(None);
            }
        }
    }

    /// Whether the person answers yes in time; `is_over` ends the wait.
    pub fn agrees(&self, is_over: impl Fn() -> bool) -> bool {
        let until = Instant::now() + PATIENCE;
        let wait = || -> Result<bool, std::convert::Infallible> {
            thread::sleep(INTERVAL);
            Ok(Instant::now() < until && !is_over())
        };
        self.answer(wait).is_ok_and(|answer| answer.is_some_and(|line| is_yes(&line)))
    }
}

/// Whether an answer is yes.
pub fn is_yes(answer: &str) -> bool {
    answer.eq_ignore_ascii_case("y") || answer.eq_ignore_ascii_case("yes")
}

fn standard_input() -> Receiver<String> {
    let (sender, lines) = mpsc::channel();
    thread::spawn(move || {
        for line in io::stdin().lines().map_while(Result::ok) {
            if sender.send(line).is_err() {
                return;
            }
        }
    });
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_person_answers_line_by_line_and_nobody_answers_nothing() {
        let person = Person::who_says(&["y", " 2 "]);
        let wait = || -> Result<bool, ()> { panic!("there is an answer at once") };
        assert!(person.agrees(|| false));
        assert_eq!(person.answer(wait), Ok(Some("2".into())));
        assert_eq!(person.answer(wait), Ok(None));
        assert!(!Person::who_says(&["no"]).agrees(|| false));
        assert!(!Person::absent().agrees(|| false));
    }
}
