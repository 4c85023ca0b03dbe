//! The branches of the images by source line, with the outcomes that their tests have taken.

use std::{collections::BTreeMap, fmt, fs, path::Path};

use addr2line::{
    Context,
    gimli::{Dwarf, EndianSlice, LittleEndian, SectionId},
};
use anyhow::Context as _;
use emulator::coverage::Record;
use lcov::report::section::{self, branch, line};
use testkit::{
    cargo::workspace,
    elf::{self, Elf, Object, ObjectSection, codes},
    thumb::{self, Flow, Instruction},
};

type Lines<'a> = Context<EndianSlice<'a, LittleEndian>>;

/// A line of the sources, and the function that it is in.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Place {
    /// Relative to the workspace for our code.
    pub file: String,
    /// From 1; 0 for code that belongs to no line.
    pub line: u32,
    /// Without the crate's hash.
    pub function: String,
    /// Whether the line is in this repository.
    pub is_ours: bool,
}

/// An instruction after which the program may continue at more than one place.
pub struct Branch {
    pub image: &'static str,
    pub address: u32,
    pub mnemonic: String,
    pub outcomes: Vec<Outcome>,
}

/// A way in which the program may continue after a branch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outcome {
    /// A verb phrase, such as "jumps".
    pub name: String,
    /// Whether the program has continued so.
    pub was_seen: bool,
}

/// A line of the sources with code.
#[derive(Default)]
pub struct Line {
    pub was_executed: bool,
    pub branches: Vec<Branch>,
}

/// The lines of our code in all images.
#[derive(Default)]
pub struct Report {
    pub lines: BTreeMap<Place, Line>,
}

impl Branch {
    /// Whether an outcome was not seen.
    pub fn is_incomplete(&self) -> bool {
        self.outcomes.iter().any(|outcome| !outcome.was_seen)
    }
}

impl fmt::Display for Branch {
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

impl Report {
    /// Adds an image, an ELF file with debug information, and what it did.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn add(&mut self, image: &'static str, elf: &Path, record: &Record) -> anyhow::Result<()> {
        let bytes = fs::read(elf).with_context(|| format!("cannot read {}", elf.display()))?;
        let file = Elf::parse(&bytes)?;
        let lines = lines(&file)?;
        for code in codes(&file)? {
            let mut last = None;
            for instruction in thumb::decode(&code) {
                let place = place(&lines, instruction.address, last.as_ref())?;
                last = Some(place.clone());
                if !place.is_ours {
                    continue;
                }
                let line = self.lines.entry(place).or_default();
                line.was_executed |= record.was_executed(instruction.address);
                let outcomes = outcomes(&instruction, record);
                if !outcomes.is_empty() {
                    let Instruction { address, mnemonic, condition, .. } = instruction;
                    let mnemonic =
                        condition.map_or(mnemonic, |condition| format!("it {condition}"));
                    line.branches.push(Branch { image, address, mnemonic, outcomes });
                }
            }
        }
        Ok(())
    }

    /// The lines and branches in the format of LCOV, each branch as a block of its own.
    pub fn lcov(&self) -> String {
        let mut lcov = lcov::Report::new();
        let mut block = 0;
        for (Place { file, line, .. }, found) in &self.lines {
            if *line == 0 {
                continue;
            }
            let file = section::Key { test_name: String::new(), source_file: file.into() };
            let section = lcov.sections.entry(file).or_default();
            // A line may belong to several functions.
            let executed = section.lines.entry(line::Key { line: *line }).or_default();
            executed.count |= u64::from(found.was_executed);
            for Branch { outcomes, .. } in &found.branches {
                let was_executed = outcomes.iter().any(|outcome| outcome.was_seen);
                for (branch, outcome) in (0..).zip(outcomes) {
                    let taken = was_executed.then_some(outcome.was_seen.into());
                    let key = branch::Key { line: *line, block, branch };
                    section.branches.insert(key, branch::Value { taken });
                }
                block += 1;
            }
        }
        lcov.into_records().map(|record| format!("{record}\n")).collect()
    }

    /// The number of the outcomes in an image, and of those that were seen.
    pub fn count(&self, image: &str) -> (usize, usize) {
        let branches = self.lines.values().flat_map(|line| &line.branches);
        let outcomes: Vec<&Outcome> =
            branches.filter(|of| of.image == image).flat_map(|of| &of.outcomes).collect();
        (outcomes.len(), outcomes.iter().filter(|outcome| outcome.was_seen).count())
    }
}

/// The outcomes of an instruction with those of the record; none for one that is no branch.
fn outcomes(instruction: &Instruction, record: &Record) -> Vec<Outcome> {
    let address = instruction.address;
    let outcome = |name: &str, was_seen| Outcome { name: name.to_owned(), was_seen };
    match (&instruction.condition, &instruction.flow) {
        (Some(_), _) => {
            let [no, yes] = record.condition(address);
            vec![outcome("is false", no), outcome("is true", yes)]
        }
        (None, Flow::Branch(_)) => {
            let [next, jump] = record.branch(address, instruction.length);
            vec![outcome("falls through", next), outcome("jumps", jump)]
        }
        (None, Flow::Table(targets)) => targets
            .iter()
            .map(|(&to, indices)| {
                let indices: Vec<String> = indices.iter().map(usize::to_string).collect();
                let name = format!("jumps by index {}", indices.join(", "));
                outcome(&name, record.has_jumped(address, to))
            })
            .collect(),
        (None, Flow::Computed) => vec![outcome("runs", record.was_executed(address))],
        _ => Vec::new(),
    }
}

/// The source lines of an image.
fn lines<'a>(file: &Elf<'a>) -> anyhow::Result<Lines<'a>> {
    let section = |id: SectionId| -> elf::Result<_> {
        let section = file.section_by_name(id.name());
        let data = section.map(|section| section.data()).transpose()?;
        Ok(EndianSlice::new(data.unwrap_or_default(), LittleEndian))
    };
    Ok(Context::from_dwarf(Dwarf::load(section)?)?)
}

/// The line of an instruction: that of the innermost call that is inlined from our code or a dependency's. Lines of the
/// standard library, and code without a line, count as their callers'. `last` is the place of the instruction before.
fn place(lines: &Lines, address: u32, last: Option<&Place>) -> anyhow::Result<Place> {
    let mut frames = lines.find_frames(address.into()).skip_all_loads()?;
    let mut innermost = None;
    while let Some(frame) = frames.next()? {
        let name = frame.function.as_ref().and_then(|function| function.raw_name().ok());
        let name = name.unwrap_or_else(|| "?".into());
        let location = frame.location.as_ref();
        let file = location.and_then(|location| location.file).unwrap_or_default();
        let line = location.and_then(|location| location.line).unwrap_or(0);
        let own = Path::new(file).strip_prefix(workspace()).ok();
        let mut place = Place {
            file: own.map_or_else(|| file.to_owned(), |own| own.display().to_string()),
            line,
            function: format!("{:#}", rustc_demangle::demangle(&name)),
            is_ours: own.is_some(),
        };
        // The compiler gives no line to code that it has merged.
        if let Some(last) = last.filter(|last| line == 0 && last.function == place.function) {
            place = last.clone();
        }
        if !file.contains("/library/") && place.line > 0 {
            return Ok(place);
        }
        innermost.get_or_insert(place);
    }
    Ok(innermost.unwrap_or_else(|| Place {
        file: String::new(),
        line: 0,
        function: "?".to_owned(),
        is_ours: false,
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    #[test]
    fn lines_and_branches_are_recorded_once() {
        let outcome = |was_seen| Outcome { name: String::new(), was_seen };
        let branch = |seen: [bool; 2]| Branch {
            image: "stm32f405",
            address: 0,
            mnemonic: String::new(),
            outcomes: seen.map(outcome).into(),
        };
        let place = |function: &str, line| Place {
            file: "src/can.rs".to_owned(),
            line,
            function: function.to_owned(),
            is_ours: true,
        };
        let mut report = Report::default();
        let mut add = |function, line, was_executed, branches| {
            report.lines.insert(place(function, line), Line { was_executed, branches });
        };
        add("a", 5, true, vec![branch([true, false]), branch([false, false])]);
        add("b", 5, false, Vec::new());
        add("b", 6, false, Vec::new());
        add("b", 0, true, Vec::new());
        let expected = "TN:\nSF:src/can.rs\nBRDA:5,0,0,1\nBRDA:5,0,1,0\nBRDA:5,1,0,-\nBRDA:5,1,1,-\nBRF:4\nBRH:1\n\
                        DA:5,1\nDA:6,0\nLF:2\nLH:1\nend_of_record\n";
        assert_eq!(report.lcov(), expected);
    }
}
