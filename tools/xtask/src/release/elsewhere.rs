//! The check that the program is the same bytes if others build it: in another folder, with another registry of cargo.

use std::{
    env, fs, io,
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context, ensure};
use emulator::{chip::Part, image::Image};
use testkit::{
    cargo::workspace,
    elf::{Elf, Object, ObjectSection},
};

use crate::tool;

/// Where the copy and its registry are. The names have other lengths than the usual ones.
const ELSEWHERE: &str = "target/release-elsewhere";

/// Checks that `elf` is what a copy of the workspace gives, and that its program is the one that the tests run.
pub fn check(chip: Part, elf: &[u8]) -> anyhow::Result<()> {
    let tested = testkit::image::build(chip)?;
    let segments = |image: &Image| -> Vec<(u32, Vec<u8>)> {
        image.segments().map(|(address, bytes)| (address, bytes.to_vec())).collect()
    };
    ensure!(
        segments(&tested) == segments(&Image::from_elf(elf)?),
        "the program is not the one that the tests run"
    );
    let elsewhere = workspace().join(ELSEWHERE);
    let (copy, home) = (elsewhere.join("a-copy-of-the-sources"), elsewhere.join("cargo-home"));
    copy_sources(&copy)?;
    link_registry(&home).context("the registry of cargo")?;
    let other = testkit::image::build_release(&copy, Some(&home), chip)?;
    ensure!(elf == other, "the ELF file depends on its folder, in {}", differences(elf, &other)?);
    println!("{}: another folder and another registry give the same bytes", chip.name());
    Ok(())
}

/// Copies what git knows, and what it would.
fn copy_sources(copy: &Path) -> anyhow::Result<()> {
    let names = tool::output(
        Command::new("git")
            .args(["ls-files", "--cached", "--others", "--exclude-standard", "-z"])
            .current_dir(workspace()),
    )?;
    for name in names.split_terminator('\0') {
        let (from, to) = (workspace().join(name), copy.join(name));
        let content = match fs::read(&from) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
            content => content.with_context(|| format!("cannot read {name}"))?,
        };
        // What is unchanged need not be built again.
        if fs::read(&to).is_ok_and(|present| present == content) {
            continue;
        }
        fs::create_dir_all(to.parent().expect("a file in the folder"))
            .and_then(|()| fs::write(&to, content))
            .with_context(|| format!("cannot write {}", to.display()))?;
    }
    Ok(())
}

/// Links what cargo has downloaded to another home of cargo, which unpacks it again.
fn link_registry(home: &Path) -> anyhow::Result<()> {
    let usual = match env::var_os("CARGO_HOME") {
        Some(home) => PathBuf::from(home),
        None => env::home_dir().context("no home folder")?.join(".cargo"),
    };
    for folder in ["registry/cache", "registry/index"] {
        link(&usual.join(folder), &home.join(folder))?;
    }
    Ok(())
}

fn link(from: &Path, to: &Path) -> anyhow::Result<()> {
    if from.is_dir() {
        fs::create_dir_all(to)?;
        for entry in fs::read_dir(from)? {
            let name = entry?.file_name();
            link(&from.join(&name), &to.join(&name))?;
        }
    } else if !to.exists() {
        fs::hard_link(from, to).or_else(|_| fs::copy(from, to).map(drop))?;
    }
    Ok(())
}

/// The names of the sections that differ.
fn differences(one: &[u8], other: &[u8]) -> anyhow::Result<String> {
    let (one, other) = (Elf::parse(one)?, Elf::parse(other)?);
    let mut names = Vec::new();
    for section in one.sections() {
        let name = section.name()?;
        let content = other.section_by_name(name).map(|other| other.data()).transpose()?;
        if content != Some(section.data()?) {
            names.push(name.to_owned());
        }
    }
    Ok(names.join(", "))
}
