//! The reasons in `docs/coverage.md` why branches are not taken.

use std::{cell::Cell, fmt};

use anyhow::{Context, ensure};

use super::program::Place;

/// A list item such as ``- `Log::find` `while at < end`: the reason``, below the heading of its file.
///
/// It stands for all branches of the lines that contain the text, in the function of that name.
#[derive(Debug)]
pub struct Explanation {
    file: String,
    function: String,
    text: String,
    pub reason: String,
    /// Whether the branch could be taken, but no test does so yet: the reason begins with "open".
    pub is_open: bool,
    is_used: Cell<bool>,
}

impl fmt::Display for Explanation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: `{}` `{}`", self.file, self.function, self.text)
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
        let mut file = None;
        let mut items: Vec<(String, String)> = Vec::new();
        let mut is_item = false;
        for line in page.lines() {
            if let Some(heading) = line.strip_prefix('#') {
                let name = heading.strip_prefix("# `").and_then(|name| name.strip_suffix('`'));
                file = name.map(str::to_owned);
                is_item = false;
            } else if let (Some(file), Some(item)) = (&file, line.strip_prefix("- ")) {
                items.push((file.clone(), item.to_owned()));
                is_item = true;
            } else if let (Some((_, item)), true, Some(more)) =
                (items.last_mut(), is_item, line.strip_prefix("  "))
            {
                item.push(' ');
                item.push_str(more.trim());
            } else {
                is_item = false;
            }
        }
        items
            .into_iter()
            .map(|(file, item)| explanation(file, &item))
            .collect::<Result<_, _>>()
            .map(Self)
    }

    /// The explanation for a line of the sources.
    pub fn find(&self, place: &Place, line: &str) -> Option<&Explanation> {
        let function = place.function.trim_end_matches("::{{closure}}");
        let found = self.0.iter().find(|explanation| {
            let is_function = function
                .strip_suffix(&explanation.function)
                .is_some_and(|path| path.is_empty() || path.ends_with("::"));
            explanation.file == place.file && is_function && line.contains(&explanation.text)
        })?;
        found.is_used.set(true);
        Some(found)
    }

    /// The explanations that no branch has needed.
    pub fn unused(&self) -> impl Iterator<Item = &Explanation> {
        self.0.iter().filter(|explanation| !explanation.is_used.get())
    }
}

fn explanation(file: String, item: &str) -> anyhow::Result<Explanation> {
    let parts = || {
        let (function, rest) = item.strip_prefix('`')?.split_once("` ")?;
        let (text, reason) = rest.strip_prefix('`')?.split_once("`: ")?;
        Some((function.to_owned(), text.to_owned(), reason.to_owned()))
    };
    let (function, text, reason) =
        parts().with_context(|| format!("no function, text and reason: - {item}"))?;
    ensure!(!reason.is_empty() && !text.is_empty(), "no text or reason: - {item}");
    let is_open = reason.starts_with("open: ");
    Ok(Explanation { file, function, text, reason, is_open, is_used: Cell::new(false) })
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAGE: &str = "# Page\n\n- a list\n\n## `src/can.rs`\n\nText.\n\n- `Can::send` `if a {`: a reason\n  of two \
                        lines\n- `Can::send` `b?`: another\n\n## Other\n\n- a list\n";

    fn place(file: &str, function: &str) -> Place {
        Place { file: file.to_owned(), line: 1, function: function.to_owned(), is_ours: true }
    }

    #[test]
    fn an_explanation_is_found_by_file_function_and_text() {
        let all = Explanations::parse(PAGE).expect("explanations");
        let found = |file, function, line| {
            all.find(&place(file, function), line).map(|explanation| explanation.reason.as_str())
        };
        assert_eq!(
            found("src/can.rs", "a::Can::send", "    if a {"),
            Some("a reason of two lines")
        );
        assert_eq!(
            found("src/can.rs", "a::Can::send::{{closure}}", "if a {"),
            Some("a reason of two lines")
        );
        assert_eq!(found("src/can.rs", "a::Can::send", "if c {"), None);
        assert_eq!(found("src/can.rs", "a::XCan::send", "if a {"), None);
        assert_eq!(found("src/flash.rs", "a::Can::send", "if a {"), None);
        assert_eq!(
            all.unused().map(ToString::to_string).collect::<Vec<_>>(),
            ["src/can.rs: `Can::send` `b?`"]
        );
    }

    #[test]
    fn an_explanation_without_its_parts_is_an_error() {
        for item in [
            "- reason",
            "- `Can::send`: reason",
            "- `Can::send` `if a {`",
            "- `Can::send` `if a {`: ",
        ] {
            Explanations::parse(&format!("## `src/can.rs`\n{item}\n")).expect_err(item);
        }
    }
}
