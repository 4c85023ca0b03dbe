//! A copy of the firmware's sources with a file changed, to be built apart from the product.

use std::{
    ffi::OsString,
    fs,
    path::{Path, PathBuf},
};

use anyhow::Context;
use toml::{Table, Value};

/// The sources of the firmware, besides the manifest.
const SOURCES: [&str; 5] = ["Cargo.lock", "build.rs", "memory.x", "src", "lss-slave"];

/// The content of a source file.
pub fn source(file: &str) -> anyhow::Result<String> {
    read(&workspace().join(file))
}

/// Copies the sources to a folder in `target`, with this content of one file. Returns the folder.
pub fn copy(folder: &str, file: &str, content: &str) -> anyhow::Result<PathBuf> {
    let workspace = workspace();
    let copy = workspace.join("target").join(folder);
    for source in SOURCES {
        mirror(&workspace.join(source), &copy.join(source), &workspace.join(file))?;
    }
    let manifest = read(&workspace.join("Cargo.toml"))?;
    write(&copy.join("Cargo.toml"), manifest_alone(&manifest)?.as_bytes())?;
    write(&copy.join(file), content.as_bytes())?;
    Ok(copy)
}

/// The manifest of the firmware as a workspace of its own.
fn manifest_alone(manifest: &str) -> anyhow::Result<String> {
    let mut table: Table = manifest.parse().context("Cargo.toml")?;
    table.insert("workspace".to_owned(), Value::Table(Table::new()));
    for key in ["dev-dependencies", "lints", "test"] {
        table.remove(key);
    }
    if let Some(Value::Table(profile)) = table.get_mut("profile") {
        profile.remove("dev");
    }
    Ok(toml::to_string(&table)?)
}

/// Mirrors a file or a folder, except for the changed file.
fn mirror(from: &Path, to: &Path, changed: &Path) -> anyhow::Result<()> {
    if from.is_dir() {
        for name in names(from)? {
            mirror(&from.join(&name), &to.join(&name), changed)?;
        }
        for name in names(to)?.iter().filter(|name| !from.join(name).exists()) {
            remove(&to.join(name))?;
        }
        return Ok(());
    }
    if from == changed {
        return Ok(());
    }
    write(to, read(from)?.as_bytes())
}

fn workspace() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("a workspace member")
}

fn names(folder: &Path) -> anyhow::Result<Vec<OsString>> {
    let entries = fs::read_dir(folder).with_context(|| folder.display().to_string())?;
    Ok(entries.map(|entry| entry.map(|entry| entry.file_name())).collect::<Result<_, _>>()?)
}

fn remove(path: &Path) -> anyhow::Result<()> {
    let removed = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
    removed.with_context(|| format!("cannot remove {}", path.display()))
}

fn read(path: &Path) -> anyhow::Result<String> {
    fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
}

/// Writes a file unless it has that content already, to avoid unnecessary builds.
fn write(path: &Path, content: &[u8]) -> anyhow::Result<()> {
    if fs::read(path).is_ok_and(|present| present == content) {
        return Ok(());
    }
    let folder = path.parent().map_or_else(PathBuf::new, Path::to_owned);
    fs::create_dir_all(&folder)
        .and_then(|()| fs::write(path, content))
        .with_context(|| format!("cannot write {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_manifest_of_the_firmware_alone_keeps_its_profile() {
        let manifest = read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../Cargo.toml"));
        let alone: Table =
            manifest_alone(&manifest.expect("readable")).expect("TOML").parse().expect("TOML");
        assert_eq!(alone["profile"]["release"]["lto"].as_str(), Some("fat"));
        assert!(alone["workspace"].as_table().is_some_and(Table::is_empty));
    }
}
