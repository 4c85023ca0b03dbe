//! The index of cases that ends `docs/conformance.md`, made of what stands in the code.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use crate::{APPLICATION_LAYER, Group, OWN, lss::LSS};

/// The page, relative to the root of the repository.
pub const PAGE: &str = "docs/conformance.md";
/// What follows on the page is made.
const BEGIN: &str = "<!-- `cargo verify conformance --index` writes what follows. -->\n";
/// The page as it is below this root, and as it must be.
///
/// # Errors
/// A file cannot be read.
pub fn pages(root: &Path) -> io::Result<(String, String)> {
    let page = fs::read_to_string(root.join(PAGE))?;
    let prose = page.split_once(BEGIN).map_or(&page[..], |(prose, _)| prose);
    let made = format!("{prose}{BEGIN}{}", cases(root)?);
    Ok((page, made))
}

/// The Rust files of a folder, in order, with their texts.
fn sources(folder: &Path) -> io::Result<Vec<(PathBuf, String)>> {
    let paths = fs::read_dir(folder)?.map(|entry| Ok(entry?.path()));
    let mut paths = paths.collect::<io::Result<Vec<PathBuf>>>()?;
    paths.retain(|path| path.extension().is_some_and(|ending| ending == "rs"));
    paths.sort();
    paths.into_iter().map(|path| Ok((path.clone(), fs::read_to_string(path)?))).collect()
}

/// The first sentence of a file, without its full stop.
fn sentence(text: &str) -> String {
    let lines = text.lines().map_while(|line| line.strip_prefix("//! "));
    let paragraph = lines.collect::<Vec<_>>().join(" ");
    let end = paragraph.find(". ").unwrap_or(paragraph.len());
    paragraph[..end].trim_end_matches('.').to_owned()
}

fn cases(root: &Path) -> io::Result<String> {
    let folder = root.join("tests/cases/src");
    let folders = [folder.join("own"), folder.join("lss"), folder];
    let files = folders.iter().map(|folder| sources(folder)).collect::<io::Result<Vec<_>>>()?;
    let files = files.concat();
    let mut text = String::from("\n## Cases\n");
    for (name, groups) in [
        ("CiA 301, numbered as in the certifier's tool", APPLICATION_LAYER),
        ("CiA 301, our own", OWN),
        ("CiA 305", LSS),
    ] {
        text += &format!("\n{name}:\n\n");
        let of_group = |group: &Group| {
            let named = format!("name: \"{}\"", group.name);
            files.iter().find(|(_, text)| text.contains(&named)).ok_or(io::ErrorKind::NotFound)
        };
        let of_groups = groups.iter().map(of_group).collect::<Result<Vec<_>, _>>()?;
        for (path, source) in &files {
            let of_file = groups.iter().zip(&of_groups).filter(|(_, (of, _))| of == path);
            let ranges = of_file.map(|(group, _)| range(group)).collect::<Vec<_>>();
            let path = path.strip_prefix(root).unwrap_or(path).display();
            if !ranges.is_empty() {
                text += &format!("- {}: `{path}`\n  {}.\n", ranges.join(", "), about(source));
            }
        }
    }
    Ok(text)
}

/// The numbers of the cases, such as `SDO 01..30`.
fn range(group: &Group) -> String {
    match group.cases.len() {
        1 => group.number(0),
        count => format!("{}..{count:02}", group.number(0)),
    }
}

/// The first sentence of a file with cases, without their numbers.
fn about(source: &str) -> String {
    let sentence = sentence(source);
    match sentence.split_once(": ") {
        Some((numbers, about)) if numbers.contains("..") || numbers.contains("EDS") => about.into(),
        _ => sentence,
    }
}

#[cfg(test)]
mod tests {
    use testkit::cargo::workspace;

    use super::*;

    #[test]
    fn the_index_of_cases_is_that_of_the_code() {
        let (page, made) = pages(workspace()).expect("the sources");
        assert!(page == made, "cargo verify conformance --index writes it");
    }
}
