//! Source code without the features of the firmware: what they exclude is removed, what they include stays.

use anyhow::{Context, bail, ensure};

/// `source` as with these features and no others. It is formatted by rustfmt.
///
/// # Errors
/// A condition is not made of `all`, `any`, `not` and features.
pub fn resolve(source: &str, features: &[&str]) -> anyhow::Result<String> {
    let mut kept: Vec<&str> = Vec::new();
    let mut lines = source.lines();
    while let Some(line) = lines.next() {
        let attribute = line.trim_start();
        let condition = attribute.strip_prefix("#[cfg(").and_then(|rest| rest.strip_suffix(")]"));
        let Some(condition) = condition.filter(|condition| condition.contains("feature = ")) else {
            kept.push(line);
            continue;
        };
        if holds(condition, features).with_context(|| attribute.to_owned())? {
            continue;
        }
        while kept.last().is_some_and(|line| is_of_next(line)) {
            kept.pop();
        }
        let indent = line.len() - attribute.len();
        let is_end = |line: &&str| {
            let text = line.trim_start();
            let ends = text.ends_with([';', ',', '}']) && !text.starts_with("#[");
            line.len() - text.len() == indent && ends
        };
        lines.find(|line| is_end(line)).with_context(|| format!("{attribute} has no end"))?;
    }
    Ok(kept.join("\n") + "\n")
}

/// Whether the line is a comment or an attribute of what follows it.
fn is_of_next(line: &str) -> bool {
    let line = line.trim_start();
    line.starts_with("//") && !line.starts_with("//!") || line.starts_with("#[")
}

/// Whether a condition holds with these features.
fn holds(condition: &str, features: &[&str]) -> anyhow::Result<bool> {
    let (result, rest) = condition_at(condition, features)?;
    ensure!(rest.is_empty(), "`{rest}` follows the condition");
    Ok(result)
}

/// The value of the condition at the start of the text, and the rest of the text.
fn condition_at<'a>(text: &'a str, features: &[&str]) -> anyhow::Result<(bool, &'a str)> {
    if let Some(rest) = text.strip_prefix("feature = \"") {
        let (feature, rest) = rest.split_once('"').context("a feature without an end")?;
        return Ok((features.contains(&feature), rest));
    }
    let (operator, mut rest) = text.split_once('(').with_context(|| format!("`{text}`"))?;
    let mut values = Vec::new();
    while !rest.starts_with(')') {
        let (value, after) = condition_at(rest, features)?;
        values.push(value);
        rest = after.strip_prefix(", ").unwrap_or(after);
    }
    let result = match (operator, &values[..]) {
        ("not", [value]) => !value,
        ("all", values) => values.iter().all(|value| *value),
        ("any", values) => values.iter().any(|value| *value),
        _ => bail!("`{operator}` is not known here"),
    };
    Ok((result, &rest[1..]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn conditions_of_features_have_their_value() {
        for (condition, expected) in [
            ("feature = \"a\"", true),
            ("feature = \"b\"", false),
            ("not(feature = \"b\")", true),
            ("all(feature = \"a\", not(feature = \"b\"))", true),
            ("all(feature = \"a\", feature = \"b\")", false),
            ("any(feature = \"b\", feature = \"a\")", true),
            ("not(any(feature = \"b\", feature = \"c\"))", true),
        ] {
            assert_eq!(holds(condition, &["a"]).expect(condition), expected, "{condition}");
        }
        for condition in ["feature = \"a", "one(feature = \"a\")", "not(feature = \"a\") x", "unix"]
        {
            holds(condition, &["a"]).expect_err(condition);
        }
    }

    #[test]
    fn what_a_feature_excludes_goes_with_its_comments_and_attributes() {
        let source = "\
//! A file.

#[cfg(feature = \"a\")]
mod a;
#[cfg(feature = \"b\")]
mod b;

struct S {
    /// One.
    one: u8,
    /// Two.
    #[cfg(feature = \"b\")]
    two: u8,
}

/// Many lines.
#[cfg(not(feature = \"a\"))]
#[inline]
fn many() {
    if true {
        one();
    }
}

#[cfg(target_os = \"none\")]
fn last() {}
";
        let expected = "\
//! A file.

mod a;

struct S {
    /// One.
    one: u8,
}


#[cfg(target_os = \"none\")]
fn last() {}
";
        assert_eq!(resolve(source, &["a"]).expect("valid"), expected);
    }
}
