//! `cargo xtask eds`: the electronic data sheets and the page of the objects, from the tables of the firmware and of
//! its example.

use std::{fs, path::Path};

use anyhow::{Context, bail};
use lss_slave_firmware::{application, describe, device, io};
use testkit::eds::{DataSheet, Product};

/// Write the electronic data sheets and docs/object-dictionary.md from the tables of the firmware
#[derive(clap::Args)]
pub struct Arguments {
    /// Only compare: fail if a file is not what the tables give
    #[arg(long)]
    check: bool,
}

/// Writes or compares the files.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let sheet = of_firmware();
    let example = DataSheet::new(
        product("io.eds", io::DESCRIPTION),
        io::Node::entries(&describe(0)),
        &io::Application::new(),
    );
    let files = [
        ("eds/lss-slave.eds", sheet.eds()),
        ("docs/object-dictionary.md", sheet.page()),
        ("eds/io.eds", example.eds()),
    ];
    let workspace = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("a workspace member");
    for (name, content) in files {
        let path = workspace.join(name);
        if !arguments.check {
            fs::write(&path, content).with_context(|| format!("cannot write {name}"))?;
            println!("{name}");
            continue;
        }
        let found = fs::read_to_string(&path).with_context(|| format!("cannot read {name}"))?;
        if let Some(difference) = difference(&found, &content) {
            bail!("{name} is not what the tables give: {difference}. Run `cargo xtask eds`");
        }
    }
    Ok(())
}

/// The data sheet of the firmware.
pub fn of_firmware() -> DataSheet<'static> {
    DataSheet::new(
        product("lss-slave.eds", device::DESCRIPTION),
        application::Node::entries(&describe(0)),
        &application::Application::new(),
    )
}

fn product(file_name: &'static str, description: &'static str) -> Product<'static> {
    Product { file_name, vendor_name: device::VENDOR_NAME, description, device: describe(0) }
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
