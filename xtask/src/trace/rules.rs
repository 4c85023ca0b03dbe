//! The rules: the rows of the tables in docs/conformance.md.

/// A row of a table.
#[derive(Debug, PartialEq)]
pub struct Rule {
    /// The section and the first words of the rule, which stay the same when rows are added or moved:
    /// `switch-state-global/any-other-mode-is-ignored`.
    pub id: String,
    pub section: String,
    pub text: String,
    /// The files of the code, from the root on.
    pub code: Vec<String>,
    /// The names of tests; `library::eds::*` for all tests of a file.
    pub tests: Vec<String>,
}

/// The number of words of a rule in its id.
const WORDS: usize = 8;

/// The rules in `text`, in their order.
pub fn parse(text: &str) -> Vec<Rule> {
    let mut section = "";
    let mut rules = Vec::new();
    for line in text.lines() {
        if let Some(heading) = line.strip_prefix("## ") {
            section = heading;
        } else if let Some([rule, code, tests]) = cells(line)
            && rule != "rule"
            && !rule.starts_with("---")
        {
            let name = section.split('(').next().unwrap_or_default();
            rules.push(Rule {
                id: format!("{}/{}", slug(name, WORDS), slug(rule, WORDS)),
                section: section.to_owned(),
                text: rule.to_owned(),
                code: names(code).map(from_root).collect(),
                tests: names(tests).map(str::to_owned).collect(),
            });
        }
    }
    rules
}

fn cells(line: &str) -> Option<[&str; 3]> {
    let (rule, tests) = line.strip_prefix('|')?.strip_suffix('|')?.rsplit_once('|')?;
    let (rule, code) = rule.rsplit_once('|')?;
    Some([rule, code, tests].map(str::trim))
}

fn names(cell: &str) -> impl Iterator<Item = &str> {
    cell.split("<br>").map(|name| name.trim().trim_matches('`')).filter(|name| !name.is_empty())
}

/// The path from the root on of a file that is named from there or from `lss-slave/src/` on.
fn from_root(path: &str) -> String {
    let is_from_root = ["src/", "xtask/"].iter().any(|directory| path.starts_with(directory));
    if is_from_root { path.to_owned() } else { format!("lss-slave/src/{path}") }
}

/// The first `words` words of `text`, as they look in a link.
fn slug(text: &str, words: usize) -> String {
    let words =
        text.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty()).take(words);
    words.map(str::to_lowercase).collect::<Vec<_>>().join("-")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_row_is_a_rule_of_its_section() {
        let text = "# Title\n\n## States (CiA 305)\n\n| rule | code | proved by |\n|---|---|---|\n\
            | After power-on the state is `waiting` | `lss/slave.rs`<br>`src/can.rs` | `library::a::one`<br>`image::b::*` |\n\
            | A rule without a test | `node.rs` | |\n\nProse | of | it\n";
        let rule = |id: &str, text: &str, code: &[&str], tests: &[&str]| Rule {
            id: id.to_owned(),
            section: "States (CiA 305)".to_owned(),
            text: text.to_owned(),
            code: code.iter().map(ToString::to_string).collect(),
            tests: tests.iter().map(ToString::to_string).collect(),
        };
        let expected = [
            rule(
                "states/after-power-on-the-state-is-waiting",
                "After power-on the state is `waiting`",
                &["lss-slave/src/lss/slave.rs", "src/can.rs"],
                &["library::a::one", "image::b::*"],
            ),
            rule(
                "states/a-rule-without-a-test",
                "A rule without a test",
                &["lss-slave/src/node.rs"],
                &[],
            ),
        ];
        assert_eq!(parse(text), expected);
    }
}
