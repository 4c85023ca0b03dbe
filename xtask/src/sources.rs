//! The Rust sources of the repository.

use std::{fs, io, path::Path};

use crate::workspace;

/// A source file.
pub struct Source {
    /// Its path from the root on, with slashes.
    pub path: String,
    pub text: String,
}

impl Source {
    /// The text with the content of comments and literals as spaces, in the same lines and columns.
    pub fn code(&self) -> String {
        code(&self.text)
    }
}

/// All of them, in the order of their paths, without those that a build makes.
pub fn all() -> io::Result<Vec<Source>> {
    let mut sources = Vec::new();
    collect(workspace(), "", &mut sources)?;
    sources.sort_by(|a, b| a.path.cmp(&b.path));
    Ok(sources)
}

fn collect(directory: &Path, prefix: &str, sources: &mut Vec<Source>) -> io::Result<()> {
    for entry in fs::read_dir(directory)? {
        let entry = entry?;
        let name = entry.file_name().to_string_lossy().into_owned();
        let is_made = name.starts_with('.') || name == "target" || name == "node_modules";
        if is_made {
            continue;
        }
        let path = format!("{prefix}{name}");
        if entry.file_type()?.is_dir() {
            collect(&entry.path(), &format!("{path}/"), sources)?;
        } else if name.ends_with(".rs") {
            sources.push(Source { path, text: fs::read_to_string(entry.path())? });
        }
    }
    Ok(())
}

fn code(text: &str) -> String {
    let mut code = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(next) = rest.chars().next() {
        let is_in_word = code.ends_with(|c: char| c.is_alphanumeric() || c == '_');
        match covered(rest).filter(|_| !(is_in_word && next.is_alphanumeric())) {
            Some(length) => {
                let (hidden, after) = rest.split_at(length);
                code.extend(hidden.chars().map(|c| if c == '\n' { c } else { ' ' }));
                rest = after;
            }
            None => {
                code.push(next);
                rest = &rest[next.len_utf8()..];
            }
        }
    }
    code
}

/// The length of the comment or literal at the start of `text`, if there is one.
fn covered(text: &str) -> Option<usize> {
    if text.starts_with("//") {
        return Some(text.find('\n').unwrap_or(text.len()));
    }
    if text.starts_with("/*") {
        let mut depth = 0;
        let mut at = 0;
        while at < text.len() {
            let step = &text.as_bytes()[at..];
            depth += i32::from(step.starts_with(b"/*")) - i32::from(step.starts_with(b"*/"));
            at += if step.starts_with(b"/*") || step.starts_with(b"*/") { 2 } else { 1 };
            if depth == 0 {
                break;
            }
        }
        return Some(at);
    }
    let body = text.trim_start_matches(['b', 'c']);
    let prefix = text.len() - body.len();
    if prefix > 1 {
        return None;
    }
    if let Some(raw) = body.strip_prefix('r') {
        let hashes = raw.len() - raw.trim_start_matches('#').len();
        let content = raw[hashes..].strip_prefix('"')?;
        let end = format!("\"{}", "#".repeat(hashes));
        let length = content.find(&end).map_or(content.len(), |at| at + end.len());
        return Some(text.len() - content.len() + length);
    }
    let quote = body.chars().next().filter(|c| ['"', '\''].contains(c))?;
    let content = &body[1..];
    if quote == '\'' && !is_character(content) {
        return None;
    }
    let mut is_escaped = false;
    let end = content.find(|c| {
        let ends = c == quote && !is_escaped;
        is_escaped = c == '\\' && !is_escaped;
        ends
    });
    Some(prefix + 1 + end.map_or(content.len(), |end| end + 1))
}

/// Whether `text`, behind an apostrophe, is the rest of a character and not of a lifetime.
fn is_character(text: &str) -> bool {
    text.starts_with('\\') || text.chars().nth(1) == Some('\'')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn comments_and_literals_are_no_code() {
        let cases = [
            ("a // b\nc", "a     \nc"),
            ("a /* b /* c */ d\n */ e", "a               \n    e"),
            (r#"f("a\"b", 'c', '\'', 'd)"#, r#"f(      ,    ,     , 'd)"#),
            ("let r#x = r#\"a\"b\"#;", "let r#x =         ;"),
            ("b\"a\" + cr\"b\"", "     +      "),
            ("for_each(\"a\")", "for_each(   )"),
            ("'outer: loop { 'x' }", "'outer: loop {     }"),
        ];
        for (text, expected) in cases {
            assert_eq!(code(text), expected, "{text}");
        }
    }

    #[test]
    fn every_line_of_every_source_stays_where_it_is() {
        let sources = all().expect("the sources");
        assert!(sources.len() > 200 && sources.iter().any(|source| source.path == "src/can.rs"));
        for source in sources {
            let code = source.code();
            assert_eq!(code.lines().count(), source.text.lines().count(), "{}", source.path);
            assert_eq!(code.matches('{').count(), code.matches('}').count(), "{}", source.path);
        }
    }
}
