//! The reasons in `docs/coverage.md` why branches are not taken.

use std::{cell::Cell, fmt, ops::Range};

use anyhow::{Context, bail, ensure};

use super::{IMAGES, PAGE, program::Place};

/// The length of a line of the page.
const COLUMNS: usize = 120;

/// The number of outcomes in each of [`IMAGES`].
type Counts = [usize; IMAGES.len()];

/// A list item such as ``- `Log::find` `while at < end` (1, 2): the reason``, below the heading of its file.
///
/// It stands for the missing outcomes of all branches of the lines that contain the text, in the function of that name.
/// A third text limits them to the outcomes that end with it.
#[derive(Debug)]
pub struct Explanation {
    file: String,
    function: String,
    text: String,
    outcome: String,
    /// The numbers of outcomes; `None` if they have not been written yet.
    counts: Option<Counts>,
    pub reason: String,
    /// Whether the branch could be taken, but no test does so yet: the reason begins with "open".
    pub is_open: bool,
    /// The numbers of outcomes that were looked up.
    found: Cell<Counts>,
}

impl Explanation {
    /// The differences between the numbers of the page and those of the images.
    fn differences(&self, images: &[&str]) -> Vec<String> {
        let mut differences = Vec::new();
        for (at, image) in IMAGES.into_iter().enumerate().filter(|(_, of)| images.contains(of)) {
            let found = self.found.get()[at];
            match self.counts.map(|counts| counts[at]) {
                Some(said) if said == found => continue,
                Some(said) => {
                    differences.push(format!("{found} in {image}, {PAGE} says {said}: {self}"))
                }
                None => {
                    differences.push(format!("{found} in {image}, {PAGE} has no number: {self}"))
                }
            }
        }
        differences
    }

    /// The beginning of the list item.
    fn subject(&self) -> String {
        let Self { function, text, outcome, .. } = self;
        let outcome = if outcome.is_empty() { String::new() } else { format!(" `{outcome}`") };
        format!("`{function}` `{text}`{outcome}")
    }
}

impl fmt::Display for Explanation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.file, self.subject())
    }
}

/// The content of `docs/coverage.md`.
#[derive(Debug)]
pub struct Explanations(Vec<Explanation>);

impl Explanations {
    /// Reads the page. Headings of its second level that are names of files begin the lists.
    ///
    /// # Errors
    /// A list item below such a heading is no explanation.
    pub fn parse(page: &str) -> anyhow::Result<Self> {
        let explanations = items(page).into_iter().map(|item| explanation(item.file, &item.text));
        explanations.collect::<Result<_, _>>().map(Self)
    }

    /// The explanation for an outcome of a branch of a line of the sources, in one of [`IMAGES`]. It is counted.
    pub fn find(
        &self,
        place: &Place,
        line: &str,
        outcome: &str,
        image: &str,
    ) -> Option<&Explanation> {
        let function = place.function.trim_end_matches("::{{closure}}");
        let found = self.0.iter().find(|explanation| {
            let is_function = function
                .strip_suffix(&explanation.function)
                .is_some_and(|path| path.is_empty() || path.ends_with("::"));
            explanation.file == place.file
                && is_function
                && line.contains(&explanation.text)
                && outcome.ends_with(&explanation.outcome)
        })?;
        let mut counts = found.found.get();
        counts[IMAGES.iter().position(|name| *name == image)?] += 1;
        found.found.set(counts);
        Some(found)
    }

    /// The explanations that no outcome has needed.
    pub fn unused(&self) -> impl Iterator<Item = &Explanation> {
        self.0.iter().filter(|explanation| explanation.found.get() == Counts::default())
    }

    /// The differences between the numbers of the page and those of the images.
    pub fn differences(&self, images: &[&str]) -> Vec<String> {
        self.0.iter().flat_map(|explanation| explanation.differences(images)).collect()
    }

    /// Whether each has its numbers.
    #[cfg(test)]
    pub fn have_counts(&self) -> bool {
        self.0.iter().all(|explanation| explanation.counts.is_some())
    }

    /// The page that these were read from, with the numbers that were found.
    pub fn with_counts(&self, page: &str) -> String {
        let lines: Vec<&str> = page.lines().collect();
        let mut text = Vec::new();
        let mut next = 0;
        for (item, explanation) in items(page).into_iter().zip(&self.0) {
            text.extend(lines[next..item.lines.start].iter().map(|line| (*line).to_owned()));
            let counts = explanation.found.get().map(|count| count.to_string()).join(", ");
            let Explanation { reason, .. } = explanation;
            text.extend(wrapped(&format!("- {} ({counts}): {reason}", explanation.subject())));
            next = item.lines.end;
        }
        text.extend(lines[next..].iter().map(|line| (*line).to_owned()));
        text.join("\n") + "\n"
    }
}

/// A list item of the page below the heading of a file.
struct Item {
    file: String,
    /// Its lines, from 0.
    lines: Range<usize>,
    /// Without the dash and the line breaks.
    text: String,
}

fn items(page: &str) -> Vec<Item> {
    let mut file = None;
    let mut items: Vec<Item> = Vec::new();
    let mut is_item = false;
    for (at, line) in page.lines().enumerate() {
        if let Some(heading) = line.strip_prefix('#') {
            let name = heading.strip_prefix("# `").and_then(|name| name.strip_suffix('`'));
            file = name.map(str::to_owned);
            is_item = false;
        } else if let (Some(file), Some(text)) = (&file, line.strip_prefix("- ")) {
            let (file, text) = (file.clone(), text.to_owned());
            items.push(Item { file, lines: at..at + 1, text });
            is_item = true;
        } else if let (Some(item), true, Some(more)) =
            (items.last_mut(), is_item, line.strip_prefix("  "))
        {
            item.text.push(' ');
            item.text.push_str(more.trim());
            item.lines.end = at + 1;
        } else {
            is_item = false;
        }
    }
    items
}

/// The lines of a list item, of at most [`COLUMNS`].
fn wrapped(item: &str) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in item.split(' ') {
        match lines.last_mut() {
            Some(line) if line.len() + 1 + word.len() <= COLUMNS => {
                line.push(' ');
                line.push_str(word);
            }
            Some(_) => lines.push(format!("  {word}")),
            None => lines.push(word.to_owned()),
        }
    }
    lines
}

fn explanation(file: String, item: &str) -> anyhow::Result<Explanation> {
    let parts = || {
        let (mut codes, mut rest) = (Vec::new(), item);
        while let Some(after) = rest.strip_prefix('`') {
            let (code, more) = after.split_once('`')?;
            codes.push(code.to_owned());
            rest = more.trim_start();
        }
        let (counts, reason) = rest.split_once(": ")?;
        let counts = match counts.strip_prefix('(') {
            Some(counts) => {
                let numbers = counts.strip_suffix(')')?.split(", ").map(str::parse);
                Some(numbers.collect::<Result<Vec<usize>, _>>().ok()?.try_into().ok()?)
            }
            None if counts.is_empty() => None,
            None => return None,
        };
        Some((codes, counts, reason.to_owned()))
    };
    let expected = || format!("no function, text, numbers and reason: - {item}");
    let (codes, counts, reason) = parts().with_context(expected)?;
    let mut codes = codes.into_iter();
    let (Some(function), Some(text)) = (codes.next(), codes.next()) else { bail!(expected()) };
    let outcome = codes.next().unwrap_or_default();
    ensure!(codes.next().is_none() && !reason.is_empty(), expected());
    ensure!(
        !outcome.is_empty() || text.contains(char::is_alphanumeric),
        "a text that many lines have needs an outcome: - {item}"
    );
    let is_open = reason.starts_with("open: ");
    let found = Cell::default();
    Ok(Explanation { file, function, text, outcome, counts, reason, is_open, found })
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "# Page\n\n- a list\n\n## `src/can.rs`\n\nText.\n\n- `Can::send` `if a {` (1, 0): a reason\n  of \
                        two lines\n- `Can::send` `}` `is true`: another\n\n## Other\n\n- a list\n";

    fn place(file: &str, function: &str) -> Place {
        Place { file: file.to_owned(), line: 1, function: function.to_owned(), is_ours: true }
    }

    /// The explanations, and the reason of one of them.
    fn find(
        page: &str,
        place: &Place,
        line: &str,
        outcome: &str,
    ) -> (Explanations, Option<String>) {
        let all = Explanations::parse(page).expect("explanations");
        let found = all.find(place, line, outcome, IMAGES[0]);
        let reason = found.map(|explanation| explanation.reason.clone());
        (all, reason)
    }

    #[test]
    fn an_explanation_is_found_by_file_function_text_and_outcome() {
        const FALSE: &str = "it eq is false";
        const REASON: Option<&str> = Some("a reason of two lines");
        for (file, function, line, outcome, reason) in [
            ("src/can.rs", "a::Can::send", "    if a {", FALSE, REASON),
            ("src/can.rs", "a::Can::send::{{closure}}", "if a {", FALSE, REASON),
            ("src/can.rs", "a::Can::send", "if c {", FALSE, None),
            ("src/can.rs", "a::XCan::send", "if a {", FALSE, None),
            ("src/flash.rs", "a::Can::send", "if a {", FALSE, None),
            ("src/can.rs", "a::Can::send", "}", "it eq is true", Some("another")),
            ("src/can.rs", "a::Can::send", "}", FALSE, None),
        ] {
            let (_, found) = find(TEXT, &place(file, function), line, outcome);
            assert_eq!(found.as_deref(), reason, "{file} {function} {line} {outcome}");
        }
    }

    #[test]
    fn an_explanation_that_nothing_needs_is_unused() {
        let (all, _) = find(TEXT, &place("src/can.rs", "Can::send"), "if a {", "beq jumps");
        let unused: Vec<String> = all.unused().map(ToString::to_string).collect();
        assert_eq!(unused, ["src/can.rs: `Can::send` `}` `is true`"]);
    }

    #[test]
    fn another_number_of_outcomes_is_a_difference() {
        let (all, _) = find(TEXT, &place("src/can.rs", "Can::send"), "if a {", "beq jumps");
        assert_eq!(all.differences(&[]), [""; 0]);
        let none = "docs/coverage.md has no number: src/can.rs: `Can::send` `}` `is true`";
        assert_eq!(all.differences(&[IMAGES[0]]), [format!("0 in {}, {none}", IMAGES[0])]);
        all.find(&place("src/can.rs", "Can::send"), "if a {", "beq jumps", IMAGES[0]);
        let said = "docs/coverage.md says 1: src/can.rs: `Can::send` `if a {`";
        assert_eq!(all.differences(&[IMAGES[0]])[0], format!("2 in {}, {said}", IMAGES[0]));
    }

    #[test]
    fn numbers_are_written_into_the_page() {
        let (all, _) = find(TEXT, &place("src/can.rs", "Can::send"), "}", "it eq is true");
        let written = all.with_counts(TEXT);
        let expected = TEXT
            .replace("(1, 0): a reason\n  of two lines", "(0, 0): a reason of two lines")
            .replace("`is true`:", "`is true` (1, 0):");
        assert_eq!(written, expected);
        let again = Explanations::parse(&written).expect("explanations");
        assert_eq!(again.differences(&IMAGES)[0].split(',').next(), Some("0 in stm32f405"));
        assert_eq!(
            again.0.iter().map(|item| item.counts).collect::<Vec<_>>(),
            [Some([0, 0]), Some([1, 0])]
        );
    }

    #[test]
    fn an_explanation_without_its_parts_is_an_error() {
        for item in [
            "- reason",
            "- `Can::send`: reason",
            "- `Can::send` `if a {`",
            "- `Can::send` `if a {`: ",
            "- `Can::send` `if a {` (1): reason",
            "- `Can::send` `if a {` (1, x): reason",
            "- `Can::send` `if a {` `b` `c` (1, 1): reason",
            "- `Can::send` `}` (1, 1): reason",
        ] {
            Explanations::parse(&format!("## `src/can.rs`\n{item}\n")).expect_err(item);
        }
    }

    #[test]
    fn a_long_item_has_lines_of_120_columns() {
        let lines = wrapped(&["word"; 60].join(" "));
        assert_eq!(lines.iter().map(String::len).collect::<Vec<_>>(), [119, 116, 66]);
        assert!(lines[1..].iter().all(|line| line.starts_with("  word")));
    }
}
