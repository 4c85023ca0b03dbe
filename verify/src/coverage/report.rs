//! The branches of the images by source line, with the outcomes that are missing.

use std::{collections::BTreeMap, fmt};

use emulator::coverage::Record;

use super::{
    branch::Outcome,
    program::{Place, Program},
};

/// A branch in an image, with its outcomes.
pub struct Judged {
    pub image: &'static str,
    pub address: u32,
    pub mnemonic: String,
    pub outcomes: Vec<Outcome>,
}

impl Judged {
    /// Whether an outcome was not seen.
    pub fn is_incomplete(&self) -> bool {
        self.outcomes.iter().any(|outcome| !outcome.was_seen)
    }
}

impl fmt::Display for Judged {
    /// The outcomes that are missing.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {:08x} {:6}", self.image, self.address, self.mnemonic)?;
        if self.outcomes.len() > 1 && !self.outcomes.iter().any(|outcome| outcome.was_seen) {
            return write!(f, " never executed");
        }
        let missing = self.outcomes.iter().filter(|outcome| !outcome.was_seen);
        let missing: Vec<String> =
            missing.map(|outcome| format!("never {}", outcome.name)).collect();
        write!(f, " {}", missing.join(", "))
    }
}

/// A line of the sources with code.
#[derive(Default)]
pub struct Line {
    pub was_executed: bool,
    pub branches: Vec<Judged>,
}

/// The lines of our code in all images.
#[derive(Default)]
pub struct Report {
    pub lines: BTreeMap<Place, Line>,
}

impl Report {
    /// Adds an image and what it did.
    pub fn add(&mut self, image: &'static str, program: Program, record: &Record) {
        for (&address, place) in program.instructions.iter().filter(|(_, place)| place.is_ours) {
            let line = self.lines.entry(place.clone()).or_default();
            line.was_executed |= record.was_executed(address);
        }
        for branch in program.branches {
            if let Some(line) = self.lines.get_mut(&program.instructions[&branch.address]) {
                line.branches.push(Judged {
                    image,
                    address: branch.address,
                    mnemonic: branch.mnemonic(),
                    outcomes: branch.outcomes(record),
                });
            }
        }
    }

    /// The number of the outcomes in an image, and of those that were seen.
    pub fn count(&self, image: &str) -> (usize, usize) {
        let branches = self.lines.values().flat_map(|line| &line.branches);
        let outcomes: Vec<&Outcome> =
            branches.filter(|of| of.image == image).flat_map(|of| &of.outcomes).collect();
        (outcomes.len(), outcomes.iter().filter(|outcome| outcome.was_seen).count())
    }
}
