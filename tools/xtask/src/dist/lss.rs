//! The program `lss` for several kinds of computers, with the licences of what it contains.

use std::{
    collections::BTreeSet,
    env, fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use anyhow::Context;
use testkit::{
    cargo::{cargo, workspace},
    release,
};

use super::Arguments;
use crate::tool;

/// The linker of MinGW, as Debian names it.
const MINGW: &str = "x86_64-w64-mingw32-gcc";

/// The kinds of computers that this one can build for.
fn targets() -> Vec<&'static str> {
    match env::consts::OS {
        "linux" => {
            // They are static: they run with each C library.
            let mut targets = vec!["x86_64-unknown-linux-musl", "aarch64-unknown-linux-musl"];
            let mingw = Command::new(MINGW).arg("--version").stdout(Stdio::null()).status();
            if mingw.is_ok() {
                targets.push("x86_64-pc-windows-gnu");
            } else {
                println!(
                    "lss for Windows is left out: {MINGW} is missing (Debian: apt install gcc-mingw-w64-x86-64)"
                );
            }
            targets
        }
        "macos" => vec!["aarch64-apple-darwin", "x86_64-apple-darwin"],
        _ => vec!["x86_64-pc-windows-msvc"],
    }
}

/// Builds it for each of them, and writes a folder for each.
pub fn write(arguments: &Arguments) -> anyhow::Result<()> {
    for target in targets() {
        tool::run(
            Command::new("rustup").args(["--quiet", "target", "add", target]),
            "the compiler's library for this target is missing",
        )?;
        let linker = format!("CARGO_TARGET_{}_LINKER", target.to_uppercase().replace('-', "_"));
        let mut build = cargo();
        build.args(["build", "--release", "--locked", "--package", "lss", "--target", target]);
        build.args(["--config", "profile.release.debug=false"]);
        build.args(["--config", "profile.release.strip=true"]);
        if target.ends_with("musl") {
            // The compiler brings it, for all processors.
            build.env(linker, "rust-lld");
        }
        tool::run(build.current_dir(workspace()), "lss does not build")?;
        let name = if target.contains("windows") { "lss.exe" } else { "lss" };
        let program = workspace().join("target").join(target).join("release").join(name);
        let read =
            |path: &Path| fs::read(path).with_context(|| format!("cannot read {}", path.display()));
        let mut files = vec![
            (name.to_owned(), read(&program)?),
            ("LICENSES.txt".to_owned(), licences(target)?.into_bytes()),
        ];
        for licence in ["LICENSE-APACHE", "LICENSE-MIT"] {
            files.push((licence.to_owned(), read(&workspace().join(licence))?));
        }
        let folder = arguments.folder(&format!("lss-{target}"));
        release::write(&folder, files)?;
        make_executable(&folder.join(name))?;
    }
    Ok(())
}

/// The packages of others that the program contains, each with its licence and the texts that it carries.
fn licences(target: &str) -> anyhow::Result<String> {
    let mut tree = cargo();
    tree.args(["tree", "--package", "lss", "--edges", "normal", "--prefix", "none"]);
    tree.args(["--target", target, "--format", "{p}|{l}"]).current_dir(workspace());
    let packages = tool::output(&mut tree)?;
    // Those of this repository have a path.
    let ours = format!(" ({}", workspace().display());
    let others: BTreeSet<&str> = packages.lines().filter(|line| !line.contains(&ours)).collect();
    let mut text = String::new();
    for package in others.into_iter().filter(|line| !line.trim().is_empty()) {
        let (package, licence) =
            package.trim_end_matches(" (*)").split_once('|').context("cargo tree")?;
        let package = package.replace(" (proc-macro)", "");
        text += &format!("==== {package}: {licence}\n");
        for (name, content) in texts(&package.replacen(" v", "-", 1))? {
            text += &format!("---- {name}\n{}\n", content.trim_end());
        }
    }
    Ok(text)
}

/// The licence texts in the folder of a package.
fn texts(package: &str) -> anyhow::Result<Vec<(String, String)>> {
    let home = env::var_os("CARGO_HOME").map(PathBuf::from);
    let home = home.or_else(|| Some(env::home_dir()?.join(".cargo"))).context("no home folder")?;
    let mut texts = Vec::new();
    for registry in fs::read_dir(home.join("registry/src")).context("the registry of cargo")? {
        let Ok(entries) = fs::read_dir(registry?.path().join(package)) else {
            continue;
        };
        for entry in entries {
            let path = entry?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let is_licence = ["LICENSE", "LICENCE", "COPYING", "COPYRIGHT", "NOTICE", "UNLICENSE"]
                .iter()
                .any(|word| name.to_uppercase().starts_with(word));
            if is_licence && path.is_file() {
                texts.push((name, fs::read_to_string(&path)?));
            }
        }
    }
    texts.sort();
    Ok(texts)
}

#[cfg(unix)]
fn make_executable(program: &Path) -> anyhow::Result<()> {
    use std::os::unix::fs::PermissionsExt;

    Ok(fs::set_permissions(program, fs::Permissions::from_mode(0o755))?)
}

#[cfg(not(unix))]
fn make_executable(_: &Path) -> anyhow::Result<()> {
    Ok(())
}
