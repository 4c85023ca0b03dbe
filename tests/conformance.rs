//! The conformance table, `docs/conformance.md`: every rule names its code and a test, and both exist.

use std::{fs, path::Path};

/// A row of the table.
#[derive(Debug, PartialEq)]
struct Row {
    rule: String,
    /// A file, from `lss-slave/src/` on.
    code: String,
    /// `binary::file::name`, or `file::name` for a file of one test.
    tests: Vec<String>,
}

/// The rows of all tables in `text`, without the heads.
fn rows(text: &str) -> Vec<Row> {
    let cells = |line: &str| -> Option<Row> {
        let (rule, tests) = line.strip_prefix('|')?.strip_suffix('|')?.rsplit_once('|')?;
        let (rule, code) = rule.rsplit_once('|')?;
        let tests = tests.split("<br>").map(|test| test.trim().trim_matches('`').to_owned());
        let tests = tests.filter(|test| !test.is_empty()).collect();
        let code = code.trim().trim_matches('`').to_owned();
        Some(Row { rule: rule.trim().to_owned(), code, tests })
    };
    let is_head = |row: &Row| row.rule == "rule" || row.rule.starts_with("---");
    text.lines().filter_map(cells).filter(|row| !is_head(row)).collect()
}

/// Whether `source` has a test of that name that runs by default.
fn has_test(source: &str, name: &str) -> bool {
    let lines = source.lines().map(str::trim);
    let function = format!("fn {name}(");
    lines
        .clone()
        .zip(lines.skip(1))
        .any(|(attribute, line)| attribute == "#[test]" && line.starts_with(&function))
}

/// The faults of the table, row by row; `source` gives the text of a file, from the root on.
fn faults(text: &str, source: impl Fn(&str) -> Option<String>) -> Vec<String> {
    let mut faults = Vec::new();
    for Row { rule, code, tests } in rows(text) {
        if source(&format!("lss-slave/src/{code}")).is_none() {
            faults.push(format!("{rule}: there is no code {code}"));
        }
        if tests.is_empty() {
            faults.push(format!("{rule}: names no test"));
        }
        for test in tests {
            let is_there = test.rsplit_once("::").is_some_and(|(file, name)| {
                let path = format!("tests/{}.rs", file.replace("::", "/"));
                source(&path).is_some_and(|source| has_test(&source, name))
            });
            if !is_there {
                faults.push(format!("{rule}: there is no test {test}"));
            }
        }
    }
    faults
}

fn read(path: &str) -> Option<String> {
    fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).ok()
}

#[test]
fn all_code_and_tests_that_the_conformance_table_names_exist() {
    let table = read("docs/conformance.md").expect("the table");
    assert!(rows(&table).len() > 60, "the table has been read");
    let faults = faults(&table, read);
    assert!(faults.is_empty(), "docs/conformance.md:\n{}", faults.join("\n"));
}

#[test]
fn a_wrong_row_is_detected() {
    const SOURCE: &str =
        "#[test]\nfn one() {}\n\n#[test]\n#[ignore]\nfn two() {}\n\nfn three() {}\n";
    let fault = |cell: &str| {
        let table = format!("| rule | code | proved by |\n|---|---|---|\n| A rule | {cell} |\n");
        let is_there = |path: &str| ["tests/file.rs", "lss-slave/src/code.rs"].contains(&path);
        faults(&table, |path| is_there(path).then(|| SOURCE.to_owned()))
    };
    assert_eq!(fault("`code.rs` | `file::one`"), [""; 0]);
    assert_eq!(fault("`code.rs` | "), ["A rule: names no test"]);
    assert_eq!(fault("`cod.rs` | `file::one`"), ["A rule: there is no code cod.rs"]);
    for wrong in ["file::on", "file::oned", "file::two", "file::three", "other::one", "one"] {
        let expected = format!("A rule: there is no test {wrong}");
        assert_eq!(fault(&format!("`code.rs` | `file::one`<br>`{wrong}`")), [expected]);
    }
}
