//! The bounds that the sources state beside their loops: `// Bound: 16 rounds: the places of the queue.`
//!
//! A round ends where the program goes back to the start of the loop. The number may be a constant of the same file, and
//! another one may hold in service, which is the scope of the page's response times: `// Bound: 2 rounds, 0 in service`.
//! `// Bound: not in service: reason.` stands above a function that is not called there, or a line whose calls are not
//! made. `bytes` stands beside a copy whose length is not a constant. A `for` over a range of constants
//! needs no words.

use std::collections::BTreeMap;

use anyhow::{Context, bail};

use super::program::{Frame, is_named};
use crate::sources;

const MARK: &str = "// Bound: ";

/// What a bound limits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unit {
    /// The rounds of a loop, each time that it is entered.
    Rounds,
    /// The length of a copy.
    Bytes,
    /// The calls of a function, or by a line, in service: none.
    Never,
}

/// A stated bound.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Bound {
    pub file: String,
    /// The line of the loop, the function or the copy.
    pub line: u32,
    pub number: u64,
    /// The bound in service, if it is another.
    pub in_service: Option<u64>,
    pub unit: Unit,
    pub reason: String,
    /// The line.
    pub text: String,
    /// The name in the line, if it begins a function.
    pub function: Option<String>,
}

/// All bounds in the sources, by file and line.
#[derive(Default)]
pub struct Stated {
    bounds: BTreeMap<(String, u32), Vec<Bound>>,
}

impl Stated {
    /// Reads the sources of the firmware and of the library.
    pub fn load() -> anyhow::Result<Self> {
        let mut stated = Self::default();
        let is_image = |path: &str| path.starts_with("src/") || path.starts_with("lss-slave/src/");
        for source in sources::all()?.iter().filter(|source| is_image(&source.path)) {
            stated.add(&source.path, &source.text)?;
        }
        Ok(stated)
    }

    /// Adds the bounds of a file.
    pub fn add(&mut self, file: &str, text: &str) -> anyhow::Result<()> {
        let lines: Vec<&str> = text.lines().map(str::trim_start).collect();
        for (at, line) in lines.iter().enumerate() {
            if let Some(rounds) = range(line, text) {
                let reason = "the range in the line".to_owned();
                self.insert(file, at, line, bound(rounds, None, Unit::Rounds, reason));
            }
            let Some(statement) = line.strip_prefix(MARK) else { continue };
            let is_more = |line: &&&str| line.starts_with("// ") && !line.starts_with(MARK);
            let mut words = vec![statement];
            words.extend(lines[at + 1..].iter().take_while(is_more).map(|line| &line[3..]));
            let is_skipped = |line: &&&str| line.starts_with("//") || line.starts_with('#');
            let below = at + 1 + lines[at + 1..].iter().take_while(is_skipped).count();
            let bound = parse(&words.join(" "), text)
                .with_context(|| format!("{file}:{}: `{line}`", at + 1))?;
            self.insert(file, below, lines.get(below).copied().unwrap_or_default(), bound);
        }
        Ok(())
    }

    fn insert(&mut self, file: &str, at: usize, text: &str, bound: Bound) {
        let (file, line) = (file.to_owned(), at as u32 + 1);
        let key = (file.clone(), line);
        let (text, function) = (text.to_owned(), function(text));
        self.bounds.entry(key).or_default().push(Bound { file, line, text, function, ..bound });
    }

    /// The bound of this kind that the innermost of the calls states.
    pub fn at(&self, frames: &[Frame], unit: Unit) -> Option<&Bound> {
        let of = |frame: &Frame| self.bounds.get(&(frame.file.clone(), frame.line));
        frames.iter().filter_map(of).flatten().find(|bound| bound.unit == unit)
    }

    /// Whether an instruction is not executed in service: its line says so, or the function that it is in.
    pub fn is_never(&self, frames: &[Frame]) -> bool {
        let is_in = |bound: &Bound| {
            let Some(function) = &bound.function else { return false };
            frames
                .iter()
                .any(|frame| is_named(&frame.function, function) && frame.file == bound.file)
        };
        self.at(frames, Unit::Never).is_some()
            || self.iter().any(|bound| bound.unit == Unit::Never && is_in(bound))
    }

    pub fn iter(&self) -> impl Iterator<Item = &Bound> {
        self.bounds.values().flatten()
    }
}

fn parse(statement: &str, text: &str) -> anyhow::Result<Bound> {
    const FORM: &str =
        "write `// Bound: 8 rounds: reason.`, with a number or a constant of this file";
    if let Some(reason) = statement.strip_prefix("not in service: ") {
        return Ok(bound(0, None, Unit::Never, reason.to_owned()));
    }
    let (amount, reason) = statement.split_once(": ").context(FORM)?;
    let (amount, in_service) = match amount.split_once(", ") {
        Some((amount, scope)) => {
            let number = scope.strip_suffix(" in service").context(FORM)?;
            (amount, Some(number.parse().context(FORM)?))
        }
        None => (amount, None),
    };
    let (number, unit) = amount.rsplit_once(' ').context(FORM)?;
    let unit = match unit {
        "rounds" | "round" => Unit::Rounds,
        "bytes" | "byte" => Unit::Bytes,
        _ => bail!(FORM),
    };
    let number = match number.replace('_', "").parse() {
        Ok(number) => number,
        Err(_) => constant(number, text).context(FORM)?,
    };
    Ok(bound(number, in_service, unit, reason.to_owned()))
}

fn bound(number: u64, in_service: Option<u64>, unit: Unit, reason: String) -> Bound {
    let reason = reason.trim_end_matches('.').to_owned();
    let (file, text) = (String::new(), String::new());
    Bound { file, line: 0, number, in_service, unit, reason, text, function: None }
}

/// The value of a constant that the file gives as a number.
fn constant(name: &str, text: &str) -> Option<u64> {
    let definition = format!("const {name}: ");
    let line = text.lines().find(|line| line.contains(&definition))?;
    let (_, value) = line.split_once(" = ")?;
    value.trim_end_matches(';').replace('_', "").parse().ok()
}

/// The rounds of a `for` over a range of constants, which needs no more words.
fn range(line: &str, text: &str) -> Option<u64> {
    let (_, range) = line.strip_prefix("for ")?.strip_suffix(" {")?.split_once(" in 0..")?;
    range.parse().ok().or_else(|| constant(range, text))
}

fn function(line: &str) -> Option<String> {
    let (_, rest) = line.split_once("fn ")?;
    Some(rest.split(['(', '<']).next()?.to_owned())
}

/// A loop of a dependency, or of code without source lines.
pub struct Dependency {
    /// The end of the name of the function that the loop was inlined from, or is in.
    pub function: &'static str,
    pub number: u64,
    pub unit: Unit,
    pub reason: &'static str,
}

/// The bounds in dependencies.
pub const DEPENDENCIES: [Dependency; 2] = [
    Dependency {
        function: "_defmt_write",
        number: 4,
        unit: Unit::Rounds,
        reason: "the bytes of a number in a log line",
    },
    Dependency {
        function: "copy_wrapping",
        number: 1,
        unit: Unit::Bytes,
        reason: "the encoder writes byte by byte",
    },
];

#[cfg(test)]
mod tests {
    use super::*;

    fn stated(text: &str) -> Vec<Bound> {
        let mut stated = Stated::default();
        stated.add("a.rs", text).expect("bounds");
        stated.iter().cloned().collect()
    }

    #[test]
    fn a_bound_belongs_to_the_code_below_its_comment() {
        let text = "// Bound: 8 rounds: the bits\n// of a byte.\n// Other words.\nloop {}\n";
        let [bound] = &stated(text)[..] else { panic!("one") };
        assert_eq!((bound.line, bound.number, bound.unit), (4, 8, Unit::Rounds));
        assert!(bound.reason.starts_with("the bits of a byte"));
    }

    #[test]
    fn a_constant_of_the_file_is_a_number() {
        let text =
            "const MOST: u32 = 1_000;\n// Bound: MOST rounds, 2 in service: so.\nwhile x {\n";
        let [bound] = &stated(text)[..] else { panic!("one") };
        assert_eq!((bound.number, bound.in_service), (1_000, Some(2)));
        assert!(Stated::default().add("a.rs", "// Bound: MOST rounds: so.\n").is_err());
    }

    #[test]
    fn a_range_of_constants_needs_no_words() {
        let text = "const N: usize = 3;\nfor _ in 0..N {\nfor i in 0..8 {\nfor i in 0..n {\n";
        let rounds: Vec<u64> = stated(text).iter().map(|bound| bound.number).collect();
        assert_eq!(rounds, [3, 8]);
    }

    #[test]
    fn another_form_is_refused() {
        for text in ["// Bound: 8.\n", "// Bound: 8 times: so.\n", "// Bound: rounds: so.\n"] {
            assert!(Stated::default().add("a.rs", text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_function_or_a_line_may_not_be_in_service() {
        let [bound] = &stated("// Bound: not in service: so.\n#[inline]\nfn f(&self) {}\n")[..]
        else {
            panic!("one")
        };
        assert_eq!((bound.unit, bound.function.as_deref()), (Unit::Never, Some("f")));
        let frame = |function: &str, line| Frame {
            file: "a.rs".to_owned(),
            line,
            function: function.to_owned(),
        };
        let mut stated = Stated::default();
        stated.add("a.rs", "// Bound: not in service: so.\nfn f() {}\n").expect("bounds");
        assert!(stated.is_never(&[frame("core::x", 9), frame("a::f", 5)]));
        assert!(!stated.is_never(&[frame("a::of", 5)]));
    }
}
