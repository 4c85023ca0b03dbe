//! The page: a table of the rules for each section, and the tests that prove none.

use std::fmt::{self, Write};

use super::{Trace, rules::Rule};

const HEAD: &str = "<!doctype html>
<html lang=\"en\">
<meta charset=\"utf-8\">
<meta name=\"viewport\" content=\"width=device-width\">
<title>Traceability</title>
<style>
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 1300px; padding: 0 1em; }
table { border-collapse: collapse; width: 100%; }
th, td { border-top: 1px solid #8885; padding: .35em .6em; text-align: left; vertical-align: top; }
td:first-child { width: 42%; }
code { font-size: 12.5px; overflow-wrap: anywhere; }
small { opacity: .65; }
.fault { color: #c22; }
:root { color-scheme: light dark; }
</style>
<h1>Traceability</h1>
";

pub fn html(trace: &Trace) -> String {
    let mut page = HEAD.to_owned();
    write(&mut page, trace).expect("a string takes all text");
    page
}

fn write(page: &mut String, trace: &Trace) -> fmt::Result {
    writeln!(
        page,
        "<p>{} rules of <code>docs/conformance.md</code>, with their code, the share of its lines that were executed \
         by the tests if it was measured, and the tests that prove them.</p>",
        trace.rules.len()
    )?;
    if !trace.faults.is_empty() {
        writeln!(page, "<h2 class=\"fault\">Faults</h2>\n<ul class=\"fault\">")?;
        for fault in &trace.faults {
            writeln!(page, "<li>{}", escaped(fault))?;
        }
        writeln!(page, "</ul>")?;
    }
    let mut section = "";
    for (rule, proof) in trace.rules.iter().zip(&trace.proofs) {
        if rule.section != section {
            section = &rule.section;
            writeln!(page, "</table>\n<h2>{}</h2>", escaped(section))?;
            writeln!(page, "<table>\n<tr><th>rule<th>code<th>proved by")?;
        }
        let tests = proof.iter().map(|index| &trace.tests[*index]);
        let tests = tests.map(|test| {
            format!("<code title=\"{}:{}\">{}</code>", test.path, test.line, escaped(&test.name))
        });
        writeln!(
            page,
            "<tr id=\"{id}\"><td>{}<br><small><a href=\"#{id}\">{id}</a></small><td>{}<td>{}",
            escaped(&rule.text),
            code(trace, rule),
            tests.collect::<Vec<_>>().join("<br>"),
            id = escaped(&rule.id),
        )?;
    }
    writeln!(page, "</table>\n<h2>Tests without a rule</h2>")?;
    writeln!(page, "<table>\n<tr><th>subject<th>place<th>tests")?;
    for (place, subject, count) in trace.without_rules() {
        writeln!(page, "<tr><td>{subject}<td><code>{place}</code><td>{count}")?;
    }
    writeln!(page, "</table>")
}

fn code(trace: &Trace, rule: &Rule) -> String {
    let files = rule.code.iter().map(|path| {
        let share = trace.coverage.get(path).map(|lines| {
            let percent = 100 * lines.executed / lines.found.max(1);
            format!(" <small>{percent} % of {} lines</small>", lines.found)
        });
        format!("<code>{}</code>{}", escaped(path), share.unwrap_or_default())
    });
    files.collect::<Vec<_>>().join("<br>")
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
