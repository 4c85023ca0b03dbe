//! Documents that are made from the sources: written, or compared with what the sources give.

use std::fs;

use anyhow::{Context, bail};

use testkit::cargo::workspace;

/// Writes `content` to the file `name`, or, if `check`, fails if the file differs. `command` writes it.
pub fn write_or_check(name: &str, content: &str, check: bool, command: &str) -> anyhow::Result<()> {
    let path = workspace().join(name);
    if !check {
        fs::write(&path, content).with_context(|| format!("cannot write {name}"))?;
        println!("{name}");
        return Ok(());
    }
    let found = fs::read_to_string(&path).with_context(|| format!("cannot read {name}"))?;
    if let Some(difference) = difference(&found, content) {
        bail!("{name} is not what the sources give: {difference}. Run `{command}`");
    }
    Ok(())
}

/// The first line that differs, if any.
fn difference(found: &str, expected: &str) -> Option<String> {
    if found == expected {
        return None;
    }
    let (mut found, mut expected) = (found.lines(), expected.lines());
    let text = |line: Option<&str>| line.map_or("the end".to_owned(), |line| format!("`{line}`"));
    (1..).find_map(|number| match (found.next(), expected.next()) {
        (None, None) => Some("the ends of the lines differ".to_owned()),
        (found, expected) if found == expected => None,
        (found, expected) => {
            Some(format!("line {number} is {}, not {}", text(found), text(expected)))
        }
    })
}

#[cfg(test)]
mod tests {
    use super::difference;

    #[test]
    fn a_difference_is_named_by_its_first_line() {
        let line_2 = |text: &str| Some(format!("line 2 is {text}"));
        assert_eq!(difference("a\nb\n", "a\nb\n"), None);
        assert_eq!(difference("a\nb\nc\n", "a\nB\nc\n"), line_2("`b`, not `B`"));
        assert_eq!(difference("a\n", "a\nb\n"), line_2("the end, not `b`"));
        assert_eq!(difference("a\nb\n", "a\n"), line_2("`b`, not the end"));
        assert!(difference("a\r\n", "a\n").is_some());
    }
}
