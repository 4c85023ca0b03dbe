//! The check that a program is the same bytes if others build it: in another folder, with another registry of cargo.

use std::{
    env, fs,
    path::{Path, PathBuf},
};

use anyhow::{Context, ensure};

use super::Program;
use crate::elf::{Elf, Object, ObjectSection};

/// Checks that a copy of the folder gives the same ELF file. What of the copy is unchanged is not built again.
pub fn check(program: &Program, copy: &Path) -> anyhow::Result<()> {
    let elf = program.elf(program.folder, None)?;
    copy_folder(program.folder, copy, &[copy, &program.folder.join("target")])
        .with_context(|| format!("cannot copy to {}", copy.display()))?;
    // The name has another length than the usual one.
    let home = copy.join("target/another-home-of-cargo");
    link_registry(&home).context("the registry of cargo")?;
    let other = program.elf(copy, Some(&home))?;
    ensure!(elf == other, "the ELF file depends on its folder, in {}", differences(&elf, &other)?);
    println!("{}: another folder and another registry give the same bytes", program.part.name());
    Ok(())
}

fn copy_folder(from: &Path, to: &Path, left_out: &[&Path]) -> anyhow::Result<()> {
    fs::create_dir_all(to)?;
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        let (from, name) = (entry.path(), entry.file_name());
        let to = to.join(&name);
        if left_out.contains(&&*from) || name == ".git" {
            continue;
        } else if from.is_dir() {
            copy_folder(&from, &to, left_out)?;
        } else if fs::read(&to).ok() != Some(fs::read(&from)?) {
            fs::copy(&from, &to)?;
        }
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
