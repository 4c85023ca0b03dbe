//! The tests in the sources, by the names that docs/conformance.md uses.

use crate::sources::Source;

/// A function with `#[test]`.
#[derive(Debug, PartialEq)]
pub struct Test {
    /// `library::eds::name`, `lss_slave::sdo::crc::name`, `firmware::io::name` and so on.
    pub name: String,
    /// From the root on.
    pub path: String,
    /// From 1 on.
    pub line: usize,
    /// Neither `cargo test` nor a part of `.ci/run` that the reason names runs it.
    pub is_ignored: bool,
}

/// The beginning of a path and that of the names of its tests.
const ROOMS: [(&str, &str); 3] =
    [("lss-slave/src/", "lss_slave::"), ("src/", "firmware::"), ("tests/", "")];

/// The tests of `source`, in their order.
pub fn of(source: &Source) -> Vec<Test> {
    let module = module(&source.path);
    let mut tests = Vec::new();
    let mut attributes = None;
    for ((line, text), code) in (1..).zip(source.text.lines()).zip(source.code().lines()) {
        let code = code.trim();
        if code == "#[test]" {
            attributes = Some(false);
        } else if let Some(is_ignored) = attributes
            && !code.is_empty()
        {
            if code.starts_with("#[") {
                let is_skipped = code.starts_with("#[ignore") && !text.contains("`.ci/run ");
                attributes = Some(is_ignored || is_skipped);
                continue;
            }
            let name = code.strip_prefix("fn ").and_then(|rest| rest.split_once('('));
            if let Some((name, _)) = name {
                let (name, path) = (format!("{module}::{name}"), source.path.clone());
                tests.push(Test { name, path, line, is_ignored });
            }
            attributes = None;
        }
    }
    tests
}

fn module(path: &str) -> String {
    let room = ROOMS.iter().find_map(|(start, name)| Some((path.strip_prefix(start)?, name)));
    let (rest, name) = room.unwrap_or((path, &""));
    let rest = rest.trim_end_matches(".rs").trim_end_matches("/tests");
    format!("{name}{}", rest.replace('-', "_").replace('/', "::"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tests_are_found_with_their_names() {
        let text = "#[test]\nfn one() {}\n\n#[test]\n#[ignore = \"long\"]\nfn two() {}\n\n\
            // #[test]\nfn three() {}\n\n#[test]\n#[ignore = \"`.ci/run chips`\"]\n/// Never.\n#[should_panic]\nfn four() {}\n";
        let found = |path: &str| {
            let source = Source { path: path.to_owned(), text: text.to_owned() };
            let tests = of(&source).into_iter();
            tests.map(|test| (test.name, test.line, test.is_ignored)).collect::<Vec<_>>()
        };
        let expected = |module: &str| {
            [("one", 2, false), ("two", 6, true), ("four", 15, false)]
                .map(|(name, line, ignored)| (format!("{module}::{name}"), line, ignored))
        };
        assert_eq!(found("tests/library/eds.rs"), expected("library::eds"));
        assert_eq!(found("tests/no_panic.rs"), expected("no_panic"));
        assert_eq!(found("lss-slave/src/sdo/crc.rs"), expected("lss_slave::sdo::crc"));
        assert_eq!(found("src/io.rs"), expected("firmware::io"));
        assert_eq!(found("emulator/src/can/tests.rs"), expected("emulator::src::can"));
    }
}
