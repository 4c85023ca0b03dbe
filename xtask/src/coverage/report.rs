//! The branches of the images by source line, with what is missing.

use std::{collections::BTreeMap, fmt, fs, path::Path, ptr};

use emulator::coverage::Record;

use super::{
    branch::Outcome,
    explanations::{Explanation, Explanations},
    program::{Place, Program},
};

/// A branch in an image, with its outcomes.
pub struct Judged<'a> {
    pub image: &'static str,
    pub address: u32,
    pub mnemonic: String,
    pub outcomes: Vec<Verdict<'a>>,
}

/// An outcome of a branch.
pub struct Verdict<'a> {
    pub outcome: Outcome,
    /// The place of the outcome's target.
    pub target: Option<Place>,
    /// The reason why it is missing.
    pub explanation: Option<&'a Explanation>,
}

impl Verdict<'_> {
    pub const fn was_seen(&self) -> bool {
        self.outcome.was_seen
    }
}

impl<'a> Judged<'a> {
    /// The outcomes that were not seen.
    pub fn missing(&self) -> impl Iterator<Item = &Verdict<'a>> {
        self.outcomes.iter().filter(|verdict| !verdict.was_seen())
    }
}

impl fmt::Display for Judged<'_> {
    /// The outcomes that are missing.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {:08x} {:6}", self.image, self.address, self.mnemonic)?;
        if self.outcomes.len() > 1 && !self.outcomes.iter().any(Verdict::was_seen) {
            return write!(f, " never executed");
        }
        for (number, Verdict { outcome, target, .. }) in self.missing().enumerate() {
            let comma = if number > 0 { "," } else { "" };
            write!(f, "{comma} never {}", outcome.name)?;
            if let Some(Place { file, line, .. }) = target {
                let name = file.rsplit('/').next().unwrap_or(file);
                write!(f, " to {name}:{line}")?;
            }
        }
        Ok(())
    }
}

/// A line of the sources with code.
#[derive(Default)]
pub struct Line<'a> {
    pub was_executed: bool,
    pub branches: Vec<Judged<'a>>,
}

impl<'a> Line<'a> {
    /// The branches with an outcome that was not seen.
    pub fn missing(&self) -> impl Iterator<Item = &Judged<'a>> {
        self.branches.iter().filter(|branch| branch.missing().next().is_some())
    }

    /// Whether an outcome is missing without an explanation.
    pub fn is_unexplained(&self) -> bool {
        let mut missing = self.branches.iter().flat_map(Judged::missing);
        missing.any(|verdict| verdict.explanation.is_none())
    }

    /// The reasons why outcomes are missing, each once.
    pub fn explanations(&self) -> Vec<&'a Explanation> {
        let mut all: Vec<&Explanation> = Vec::new();
        for explanation in
            self.branches.iter().flat_map(Judged::missing).filter_map(|verdict| verdict.explanation)
        {
            if !all.iter().any(|other| ptr::eq(*other, explanation)) {
                all.push(explanation);
            }
        }
        all
    }
}

/// The numbers of outcomes.
#[derive(Clone, Copy, Default)]
pub struct Count {
    pub seen: usize,
    pub explained: usize,
    pub open: usize,
    pub unexplained: usize,
}

impl Count {
    /// Adds the outcomes of some branches.
    fn add<'a>(&mut self, branches: impl Iterator<Item = &'a Judged<'a>>) {
        for verdict in branches.flat_map(|branch| &branch.outcomes) {
            *match verdict.explanation {
                _ if verdict.was_seen() => &mut self.seen,
                None => &mut self.unexplained,
                Some(explanation) if explanation.is_open => &mut self.open,
                Some(_) => &mut self.explained,
            } += 1;
        }
    }

    /// The number of all outcomes.
    pub fn total(&self) -> usize {
        self.seen + self.explained + self.open + self.unexplained
    }
}

/// All lines of all images.
#[derive(Default)]
pub struct Report<'a> {
    pub lines: BTreeMap<Place, Line<'a>>,
    /// The text of our files.
    pub sources: BTreeMap<String, Vec<String>>,
}

impl<'a> Report<'a> {
    /// Adds an image and what it did.
    pub fn add(&mut self, image: &'static str, program: &Program, record: &Record) {
        for (&address, place) in &program.instructions {
            let line = self.lines.entry(place.clone()).or_default();
            line.was_executed |= record.was_executed(address);
        }
        for branch in &program.branches {
            let verdict = |outcome: Outcome| Verdict {
                target: outcome.target.and_then(|to| program.instructions.get(&to).cloned()),
                outcome,
                explanation: None,
            };
            let judged = Judged {
                image,
                address: branch.address,
                mnemonic: branch.mnemonic(),
                outcomes: branch.outcomes(record).into_iter().map(verdict).collect(),
            };
            let place = program.instructions[&branch.address].clone();
            self.lines.entry(place).or_default().branches.push(judged);
        }
    }

    /// Reads the sources of our code, and looks up what is missing there.
    ///
    /// # Errors
    /// A source cannot be read.
    pub fn explain(
        &mut self,
        workspace: &Path,
        explanations: &'a Explanations,
    ) -> anyhow::Result<()> {
        for (place, line) in self.lines.iter_mut().filter(|(place, _)| place.is_ours) {
            if !self.sources.contains_key(&place.file) {
                let source = fs::read_to_string(workspace.join(&place.file))?;
                self.sources
                    .insert(place.file.clone(), source.lines().map(str::to_owned).collect());
            }
            let source = text(&self.sources, place);
            for branch in &mut line.branches {
                for verdict in branch.outcomes.iter_mut().filter(|verdict| !verdict.was_seen()) {
                    let outcome = format!("{} {}", branch.mnemonic, verdict.outcome.name);
                    verdict.explanation = explanations.find(place, source, &outcome, branch.image);
                }
            }
        }
        Ok(())
    }

    /// The text of a line of our code.
    pub fn text(&self, place: &Place) -> &str {
        text(&self.sources, place)
    }

    /// The lines of our code.
    pub fn ours(&self) -> impl Iterator<Item = (&Place, &Line<'a>)> {
        self.lines.iter().filter(|(place, _)| place.is_ours)
    }

    /// The outcomes in one of our files, or in all of them, in one image or in all.
    pub fn count(&self, file: Option<&str>, image: Option<&str>) -> Count {
        let mut count = Count::default();
        for (_, line) in self.ours().filter(|(place, _)| file.is_none_or(|file| place.file == file))
        {
            let branches = line
                .branches
                .iter()
                .filter(|branch| image.is_none_or(|image| branch.image == image));
            count.add(branches);
        }
        count
    }

    /// The outcomes in dependencies and start-up code, by crate.
    pub fn dependencies(&self) -> BTreeMap<String, Count> {
        let mut all: BTreeMap<String, Count> = BTreeMap::new();
        for (place, line) in
            self.lines.iter().filter(|(place, line)| !place.is_ours && !line.branches.is_empty())
        {
            all.entry(crate_of(&place.file)).or_default().add(line.branches.iter());
        }
        all
    }
}

fn text<'a>(sources: &'a BTreeMap<String, Vec<String>>, place: &Place) -> &'a str {
    let line =
        place.line.checked_sub(1).and_then(|line| sources.get(&place.file)?.get(line as usize));
    line.map_or("no line", |line| line.trim())
}

/// The crate of a source file outside of the workspace.
fn crate_of(file: &str) -> String {
    let name = match (file.split_once("/library/"), file.split_once("/registry/src/")) {
        (Some((_, path)), _) => path.split('/').next(),
        (_, Some((_, path))) => path.split('/').nth(1),
        _ => None,
    };
    name.unwrap_or("assembly").to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dependency_is_named_by_its_crate() {
        for (file, name) in [
            (
                "/root/.cargo/registry/src/index.crates.io-1949/bxcan-0.8.0/src/lib.rs",
                "bxcan-0.8.0",
            ),
            ("/rustc/59807616e1fa/library/core/src/option.rs", "core"),
            ("", "assembly"),
        ] {
            assert_eq!(crate_of(file), name);
        }
    }
}
