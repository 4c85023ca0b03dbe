//! The documents: links, paths and commands that they name exist, what is generated is up to date, and prose keeps to
//! one width.

use std::{
    fs,
    path::{Path, PathBuf},
};

use testkit::{cargo::workspace, eds::ours};

/// The directories with documents.
const DIRECTORIES: [&str; 11] = [
    "",
    "docs",
    "examples/commissioner",
    "libs/can-bus",
    "libs/canopen-node",
    "libs/lss-master",
    "libs/lss-slave",
    "libs/program-update",
    "fuzz",
    "tests/clients",
    "tools/lss",
];
/// Directories that commands make.
const MADE: [&str; 2] = ["target/", "fuzz/artifacts/"];
/// The greatest width of prose; tables and printed output may be wider.
const WIDTH: usize = 120;
/// The endings that make a word with a slash the path of a file.
const ENDINGS: [&str; 8] = [".eds", ".js", ".md", ".py", ".rs", ".svg", ".toml", ".x"];

/// The path of each document, from the root on, and its text.
fn documents() -> Vec<(PathBuf, String)> {
    let entries = DIRECTORIES.iter().flat_map(|directory| {
        let entries =
            fs::read_dir(workspace().join(directory)).expect("a directory with documents");
        entries.map(|entry| entry.expect("an entry").path())
    });
    let documents = entries.filter(|path| path.extension().is_some_and(|ending| ending == "md"));
    let with_text = documents.map(|path| {
        let text = fs::read_to_string(&path).expect("a document is text");
        (path.strip_prefix(workspace()).expect("it is below the root").to_owned(), text)
    });
    with_text.collect()
}

/// The targets of the links in `text`.
fn links(text: &str) -> impl Iterator<Item = &str> {
    text.split("](").skip(1).filter_map(|rest| rest.split_once(')')).map(|(target, _)| target)
}

/// The name of a heading in a link: `Write the image` is `write-the-image`.
fn anchor(heading: &str) -> String {
    let kept = |c: &char| c.is_alphanumeric() || " -_".contains(*c);
    heading.trim().to_lowercase().chars().filter(kept).collect::<String>().replace(' ', "-")
}

fn has_heading(text: &str, name: &str) -> bool {
    let headings = text.lines().filter(|line| line.starts_with('#'));
    headings.map(|line| anchor(line.trim_start_matches('#'))).any(|heading| heading == name)
}

/// The words of `text` that are paths in this repository: `src/main.rs`, `docs/`, `tests/library/supervision*.rs`.
fn paths(text: &str) -> impl Iterator<Item = &str> {
    let is_of_path = |c: char| c.is_ascii_alphanumeric() || "._-/*:".contains(c);
    text.split(move |c| !is_of_path(c)).map(|word| word.trim_end_matches(['.', ':'])).filter(
        |word| {
            let is_file = ENDINGS.iter().any(|ending| word.ends_with(ending));
            word.contains('/') && !word.contains(':') && (is_file || word.ends_with('/'))
        },
    )
}

/// Whether `path` exists, where its last part may have one `*`.
fn exists(directory: &Path, path: &str) -> bool {
    let path = directory.join(path);
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let Some((start, end)) = name.split_once('*') else { return path.exists() };
    let entries = path.parent().and_then(|parent| fs::read_dir(parent).ok());
    entries.into_iter().flatten().flatten().any(|entry| {
        let name = entry.file_name();
        name.to_str().is_some_and(|name| name.starts_with(start) && name.ends_with(end))
    })
}

fn assert_none(faults: &[String]) {
    assert!(faults.is_empty(), "\n{}", faults.join("\n"));
}

#[test]
fn every_link_leads_to_a_file_and_to_a_heading_in_it() {
    let mut faults = Vec::new();
    for (document, text) in documents() {
        for link in links(&text).filter(|link| !link.contains("://")) {
            let (path, heading) = link.split_once('#').unwrap_or((link, ""));
            let target = match path {
                "" => workspace().join(&document),
                path => workspace().join(&document).with_file_name(path),
            };
            let leads = match fs::read_to_string(&target) {
                Ok(text) => heading.is_empty() || has_heading(&text, heading),
                Err(_) => heading.is_empty() && target.exists(),
            };
            if !leads {
                faults.push(format!("{}: {link}", document.display()));
            }
        }
    }
    assert_none(&faults);
}

#[test]
fn every_path_that_a_document_names_exists() {
    let mut faults = Vec::new();
    for (document, text) in documents() {
        let own = workspace().join(&document).with_file_name("");
        let folders = ["", "libs/canopen-node/src", "libs/lss-slave/src", "template"];
        let places: Vec<_> =
            folders.map(|folder| workspace().join(folder)).into_iter().chain([own]).collect();
        let is_made = |path: &&str| MADE.iter().any(|directory| path.starts_with(directory));
        for path in paths(&text).filter(|path| !is_made(path)) {
            if !places.iter().any(|place| exists(place, path)) {
                faults.push(format!("{}: {path}", document.display()));
            }
        }
    }
    assert_none(&faults);
}

#[test]
fn every_command_of_the_project_that_a_document_names_exists() {
    let mut faults = Vec::new();
    for (tool, folder) in [("xtask", "tools/xtask"), ("verify", "tests/campaigns")] {
        let main =
            fs::read_to_string(workspace().join(folder).join("src/main.rs")).expect("the commands");
        let run = |name: &str| format!("=> {}::run(", name.replace('-', "_"));
        for (document, text) in documents() {
            for command in text.split(&format!("cargo {tool} ")).skip(1) {
                let is_of_name = |c: char| c.is_ascii_lowercase() || c == '-';
                let name = command.split(|c| !is_of_name(c)).next().unwrap_or_default();
                if !name.starts_with('-') && !main.contains(&run(name)) {
                    faults.push(format!("{}: cargo {tool} {name}", document.display()));
                }
            }
        }
    }
    assert_none(&faults);
}

#[test]
fn the_data_sheets_and_the_page_of_the_objects_are_what_the_tables_give() {
    ours::check().unwrap_or_else(|error| panic!("{error:#}"));
}

#[test]
fn the_readme_names_the_emulator_before_the_first_adapter() {
    let readme = fs::read_to_string(workspace().join("README.md")).expect("it is there");
    let at = |words: &str| readme.find(words).expect("it is named");
    assert!(at("cargo emulate") < at("/dev/ttyACM0"));
}

#[test]
fn the_rust_of_the_readme_is_compiled() {
    let read = |path: &str| fs::read_to_string(workspace().join(path)).expect("it is there");
    let (readme, tested) = (read("README.md"), read("src/application.rs").replace("//! ", ""));
    let mut blocks = readme.split("```rust\n").skip(1).filter_map(|rest| rest.split_once("```"));
    let (shown, _) = blocks.next().expect("it shows Rust");
    assert!(tested.replace("//!", "").contains(shown), "the documentation of src/application.rs");
    assert!(blocks.next().is_none());
}

#[test]
fn every_package_for_others_says_what_it_is_and_how_it_is_added() {
    let read = |path: &str| fs::read_to_string(workspace().join(path)).unwrap_or_default();
    let manifest = read("Cargo.toml");
    let members = manifest.lines().find(|line| line.starts_with("members = ")).expect("members");
    let mut faults = Vec::new();
    for folder in members.split('"').filter(|member| member.contains('/')) {
        let manifest = read(&format!("{folder}/Cargo.toml"));
        let of_name = manifest.lines().find_map(|line| line.strip_prefix("name = \""));
        let name = of_name.expect("a name").trim_end_matches('"');
        if manifest.contains("publish = false") {
            continue;
        }
        let words =
            ["description = ", "keywords = ", "categories = ", "[package.metadata.docs.rs]"];
        let missing = words.into_iter().filter(|word| !manifest.contains(word));
        faults.extend(missing.map(|word| format!("{folder}/Cargo.toml: {word}")));
        let added = ["add", "install"].map(|verb| format!("\ncargo {verb} {name}\n"));
        let readme = read(&format!("{folder}/README.md"));
        if !added.iter().any(|command| readme.contains(command)) {
            faults.push(format!("{folder}/README.md: {}", added[0].trim()));
        }
        let licences = ["LICENSE-APACHE", "LICENSE-MIT"].map(|name| format!("{folder}/{name}"));
        faults.extend(licences.into_iter().filter(|path| read(path).is_empty()));
    }
    assert_none(&faults);
}

#[test]
fn prose_is_at_most_120_columns_wide() {
    let mut faults = Vec::new();
    for (document, text) in documents() {
        let mut is_prose = true;
        for (number, line) in (1..).zip(text.lines()) {
            is_prose ^= line.starts_with("```");
            if is_prose && !line.starts_with('|') && line.chars().count() > WIDTH {
                faults.push(format!("{}:{number}", document.display()));
            }
        }
    }
    assert_none(&faults);
}

#[test]
fn faults_of_a_document_are_detected() {
    assert!(documents().len() > 10, "they are found");
    let links: Vec<_> = links("[a](b.md), ![c](d.svg#e) and (f)").collect();
    assert_eq!(links, ["b.md", "d.svg#e"]);
    assert!(has_heading("# One\n\n## Two, 3\n", "two-3") && !has_heading("## One\n", "two"));
    let words = "See `src/main.rs`, docs/ and tests/*.rs, not 1/2, a/b or https://probe.rs/x.rs.";
    assert_eq!(paths(words).collect::<Vec<_>>(), ["src/main.rs", "docs/", "tests/*.rs"]);
    assert!(exists(workspace(), "tests/doc*.rs") && !exists(workspace(), "tests/doc*.md"));
    assert!(exists(workspace(), "src/") && !exists(workspace(), "src/none.rs"));
}
