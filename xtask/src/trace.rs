//! `cargo xtask trace`: each rule of docs/conformance.md with its code, the coverage of the code, and the tests that
//! prove the rule; and each test with its rules.

mod coverage;
mod page;
mod rules;
mod suite;

use std::{
    collections::{BTreeMap, HashMap, HashSet},
    fs,
};

use anyhow::{Context, bail};
use serde_json::json;

use crate::{sources, workspace};
use coverage::Lines;
use rules::Rule;
use suite::Test;

const TABLE: &str = "docs/conformance.md";
/// Written by `cargo xtask coverage`.
const COVERAGE: &str = "target/coverage/lcov.info";

/// Where tests are that prove no rule of the product, and their subject.
const WITHOUT_RULES: [(&str, &str); 8] = [
    ("demo/", "the demonstration"),
    ("emulator/", "the emulated boards, against RM0090"),
    ("hil/", "the session for real boards"),
    ("testkit/", "the test kit"),
    ("tests/clients/", "sessions with independent masters"),
    ("tests/documents.rs", "links, paths and commands in the documents"),
    ("tests/qemu.rs", "the emulated core, against QEMU"),
    ("xtask/", "the commands of the project"),
];

/// Trace each rule of docs/conformance.md to its code, its tests and the coverage of the code
///
/// Writes target/traceability.html and target/traceability.json. The coverage is that of the last `cargo xtask
/// coverage`, if there was one.
#[derive(clap::Args)]
pub struct Arguments {
    /// Fail if a rule has no test, if a file or a test does not exist, or if a test proves no rule
    #[arg(long)]
    check: bool,
}

/// The rules and the tests, with the references between them resolved.
struct Trace {
    rules: Vec<Rule>,
    tests: Vec<Test>,
    /// For each rule the indices of its tests.
    proofs: Vec<Vec<usize>>,
    /// For each test the indices of its rules.
    proved: Vec<Vec<usize>>,
    /// By file, from the root on.
    coverage: BTreeMap<String, Lines>,
    faults: Vec<String>,
}

/// Writes the page and the file for machines.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let trace = read()?;
    let directory = workspace().join("target");
    fs::create_dir_all(&directory)?;
    fs::write(directory.join("traceability.html"), page::html(&trace))?;
    fs::write(directory.join("traceability.json"), serde_json::to_string_pretty(&json(&trace))?)?;
    for fault in &trace.faults {
        println!("{fault}");
    }
    let bound = (0..trace.tests.len()).filter(|index| !trace.proved[*index].is_empty()).count();
    println!(
        "{} rules, {bound} tests that prove them, {} other tests, {} faults: target/traceability.html",
        trace.rules.len(),
        trace.tests.len() - bound,
        trace.faults.len(),
    );
    if arguments.check && !trace.faults.is_empty() {
        bail!("{TABLE} and the sources do not agree");
    }
    Ok(())
}

fn read() -> anyhow::Result<Trace> {
    let table = fs::read_to_string(workspace().join(TABLE)).context(TABLE)?;
    let sources = sources::all()?;
    let files = sources.iter().map(|source| source.path.as_str()).collect();
    let tests = sources.iter().flat_map(suite::of).collect();
    let coverage = fs::read_to_string(workspace().join(COVERAGE)).unwrap_or_default();
    Ok(Trace::new(rules::parse(&table), tests, &files, coverage::parse(&coverage)))
}

impl Trace {
    fn new(
        rules: Vec<Rule>,
        tests: Vec<Test>,
        files: &HashSet<&str>,
        coverage: BTreeMap<String, Lines>,
    ) -> Self {
        let mut faults = Vec::new();
        let mut proofs = Vec::new();
        let mut proved = vec![Vec::new(); tests.len()];
        let mut ids = HashSet::new();
        let by_name: HashMap<&str, usize> =
            tests.iter().enumerate().map(|(index, test)| (test.name.as_str(), index)).collect();
        for (number, rule) in rules.iter().enumerate() {
            if !ids.insert(&rule.id) {
                faults.push(format!("{}: another rule begins with these words", rule.id));
            }
            if rule.code.is_empty() {
                faults.push(format!("{}: names no code", rule.id));
            }
            for code in rule.code.iter().filter(|code| !files.contains(code.as_str())) {
                faults.push(format!("{}: there is no code {code}", rule.id));
            }
            if rule.tests.is_empty() {
                faults.push(format!("{}: names no test", rule.id));
            }
            let mut proof = Vec::new();
            for name in &rule.tests {
                let found: Vec<usize> = match name.strip_suffix('*') {
                    Some(module) => (0..tests.len())
                        .filter(|index| is_in(&tests[*index].name, module))
                        .collect(),
                    None => by_name.get(name.as_str()).copied().into_iter().collect(),
                };
                if found.is_empty() {
                    faults.push(format!("{}: there is no test {name}", rule.id));
                }
                proof.extend(found);
            }
            proof.sort_unstable();
            proof.dedup();
            for index in proof.iter().copied() {
                proved[index].push(number);
                if tests[index].is_ignored {
                    faults.push(format!("{}: {} is ignored", rule.id, tests[index].name));
                }
            }
            proofs.push(proof);
        }
        for (test, _) in tests.iter().zip(&proved).filter(|(_, rules)| rules.is_empty()) {
            if subject_without_rule(&test.path).is_none() {
                faults.push(format!("{}:{}: {} proves no rule", test.path, test.line, test.name));
            }
        }
        Self { rules, tests, proofs, proved, coverage, faults }
    }

    /// The number of tests without a rule in each place where none is needed, with its subject.
    fn without_rules(&self) -> impl Iterator<Item = (&'static str, &'static str, usize)> {
        let is_in = |test: &Test, place| test.path.starts_with(place);
        WITHOUT_RULES.into_iter().map(move |(place, subject)| {
            (place, subject, self.tests.iter().filter(|test| is_in(test, place)).count())
        })
    }
}

/// Whether `name` is a test of the module `module`, which ends in `::`.
fn is_in(name: &str, module: &str) -> bool {
    name.strip_prefix(module).is_some_and(|rest| !rest.contains("::"))
}

fn subject_without_rule(path: &str) -> Option<&'static str> {
    let mut places = WITHOUT_RULES.into_iter();
    places.find_map(|(place, subject)| path.starts_with(place).then_some(subject))
}

fn json(trace: &Trace) -> serde_json::Value {
    let code = |path: &String| {
        let lines = trace.coverage.get(path);
        json!({
            "file": path,
            "lines": lines.map(|lines| lines.found),
            "executed": lines.map(|lines| lines.executed),
        })
    };
    let rules = trace.rules.iter().zip(&trace.proofs).map(|(rule, proof)| {
        json!({
            "id": rule.id,
            "section": rule.section,
            "rule": rule.text,
            "code": rule.code.iter().map(code).collect::<Vec<_>>(),
            "tests": proof.iter().map(|index| &trace.tests[*index].name).collect::<Vec<_>>(),
        })
    });
    let tests = trace.tests.iter().zip(&trace.proved).map(|(test, rules)| {
        json!({
            "name": test.name,
            "file": test.path,
            "line": test.line,
            "rules": rules.iter().map(|index| &trace.rules[*index].id).collect::<Vec<_>>(),
            "subject": subject_without_rule(&test.path),
        })
    });
    json!({
        "rules": rules.collect::<Vec<_>>(),
        "tests": tests.collect::<Vec<_>>(),
        "faults": trace.faults,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn test(name: &str, path: &str, is_ignored: bool) -> Test {
        Test { name: name.to_owned(), path: path.to_owned(), line: 7, is_ignored }
    }

    fn faults(rows: &str) -> Vec<String> {
        let table = format!("## One\n| rule | code | proved by |\n|---|---|---|\n{rows}\n");
        let tests = vec![
            test("library::a::one", "tests/library/a.rs", false),
            test("library::a::two", "tests/library/a.rs", false),
            test("library::a::b::late", "emulator/b.rs", false),
            test("image::c::skipped", "demo/c.rs", true),
        ];
        let files = HashSet::from(["lss-slave/src/node.rs"]);
        Trace::new(rules::parse(&table), tests, &files, BTreeMap::new()).faults
    }

    #[test]
    fn each_fault_of_the_table_is_found() {
        assert_eq!(faults("| A rule | `node.rs` | `library::a::*` |"), [""; 0]);
        assert_eq!(
            faults("| A rule | `node.rs` | `library::a::one`<br>`library::a::two` |"),
            [""; 0]
        );
        let all = "| All | `node.rs` | `library::a::*` |\n";
        let fault = |row: &str| faults(&format!("{all}{row}"));
        assert_eq!(fault("| A rule | `node.rs` | |"), ["one/a-rule: names no test"]);
        assert_eq!(fault("| A rule | | `library::a::one` |"), ["one/a-rule: names no code"]);
        assert_eq!(
            fault("| A rule | `nod.rs` | `library::a::one` |"),
            ["one/a-rule: there is no code lss-slave/src/nod.rs"]
        );
        for wrong in ["library::a::on", "library::b::*", "one"] {
            let expected = format!("one/a-rule: there is no test {wrong}");
            assert_eq!(fault(&format!("| A rule | `node.rs` | `{wrong}` |")), [expected]);
        }
        assert_eq!(
            fault("| A rule | `node.rs` | `image::c::skipped` |"),
            ["one/a-rule: image::c::skipped is ignored"]
        );
        assert_eq!(fault(all), ["one/all: another rule begins with these words"]);
    }

    #[test]
    fn a_test_of_the_product_without_a_rule_is_a_fault() {
        assert_eq!(
            faults("| A rule | `node.rs` | `library::a::one` |"),
            ["tests/library/a.rs:7: library::a::two proves no rule"]
        );
    }
}
