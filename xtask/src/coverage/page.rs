//! The report as a page of HTML that needs no other file.

use std::{
    collections::BTreeMap,
    fmt::{self, Write},
};

use super::{
    program::Place,
    report::{Count, Line, Report},
};

const STYLE: &str = include_str!("page.css");

/// The page: a table of the files, then each file with its lines and the branches that are missing.
pub fn page(report: &Report, images: &[&str]) -> Result<String, fmt::Error> {
    let mut text = String::new();
    writeln!(
        text,
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\n<title>Branches of the release image</title>\n\
         <meta name=\"viewport\" content=\"width=device-width\">\n<style>\n{STYLE}</style></head><body>\n\
         <h1>Branches of the release image</h1>\n\
         <p>Each branch of the object code has two outcomes or more. The tests of the image have shown those that count as \
         taken. <code>docs/coverage.md</code> explains why others cannot be.</p>\n\
         <p class=\"key\"><span class=\"run\">executed</span> <span class=\"idle\">not executed</span> \
         <span class=\"explained\">cannot be taken</span> <span class=\"open\">open</span> <span class=\"unexplained\">not explained</span></p>"
    )?;
    writeln!(
        text,
        "<table><tr><th>image</th><th>outcomes</th><th>taken</th><th>cannot be</th><th>open</th><th>not explained</th></tr>"
    )?;
    for image in images {
        row(&mut text, &escape(image), report.count(None, Some(image)))?;
    }
    writeln!(
        text,
        "</table>\n<table><tr><th>file</th><th>outcomes</th><th>taken</th><th>cannot be</th><th>open</th><th>not explained</th></tr>"
    )?;
    for file in report.sources.keys() {
        let link = format!("<a href=\"#{0}\">{0}</a>", escape(file));
        row(&mut text, &link, report.count(Some(file), None))?;
    }
    writeln!(text, "</table>")?;
    for (file, source) in &report.sources {
        source_file(&mut text, report, file, source)?;
    }
    writeln!(text, "</body></html>")?;
    Ok(text)
}

fn row(text: &mut String, name: &str, count: Count) -> fmt::Result {
    let Count { seen, explained, open, unexplained } = count;
    let class = if unexplained > 0 { " class=\"unexplained\"" } else { "" };
    writeln!(
        text,
        "<tr><td>{name}</td><td>{}</td><td>{seen}</td><td>{explained}</td><td>{open}</td><td{class}>{unexplained}</td></tr>",
        count.total()
    )
}

fn source_file(text: &mut String, report: &Report, file: &str, source: &[String]) -> fmt::Result {
    let mut lines: BTreeMap<u32, Vec<(&Place, &Line)>> = BTreeMap::new();
    for (place, line) in report.ours().filter(|(place, _)| place.file == file) {
        lines.entry(place.line).or_default().push((place, line));
    }
    let open =
        if lines.values().flatten().any(|(_, line)| line.is_unexplained()) { " open" } else { "" };
    writeln!(text, "<details id=\"{0}\"{open}><summary>{0}</summary>\n<pre>", escape(file))?;
    for (number, content) in (1..).zip(source) {
        let here = lines.get(&number).map_or(&[][..], Vec::as_slice);
        let class = match here {
            [] => "",
            _ if here.iter().any(|(_, line)| line.is_unexplained()) => " unexplained",
            _ if here.iter().any(|(_, line)| is_open(line)) => " open",
            _ if here.iter().any(|(_, line)| line.missing().next().is_some()) => " explained",
            _ if here.iter().any(|(_, line)| line.was_executed) => " run",
            _ => " idle",
        };
        write!(text, "<span class=\"line{class}\"><b>{number:5}</b> {}</span>", escape(content))?;
        for (place, line) in here {
            notes(text, place, line)?;
        }
    }
    writeln!(text, "</pre></details>")
}

/// Whether an outcome could be taken, but no test does so yet.
fn is_open(line: &Line) -> bool {
    line.explanations().iter().any(|explanation| explanation.is_open)
}

/// What is missing on a line.
fn notes(text: &mut String, place: &Place, line: &Line) -> fmt::Result {
    if line.missing().next().is_none() {
        return Ok(());
    }
    let class = match () {
        () if line.is_unexplained() => "unexplained",
        () if is_open(line) => "open",
        () => "explained",
    };
    write!(text, "<span class=\"note {class}\">{}", escape(&place.function))?;
    for branch in line.missing() {
        write!(text, "\n  {}", escape(&branch.to_string()))?;
    }
    for explanation in line.explanations() {
        write!(text, "\n  {}", escape(&explanation.reason))?;
    }
    write!(text, "</span>")
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
