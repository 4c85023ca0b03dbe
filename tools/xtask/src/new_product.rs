//! `cargo xtask new-product`: a product in a folder of its own, which takes the protocol and the drivers from here.

use std::{
    env,
    path::{Component, Path, PathBuf},
    process::{Command, Stdio},
};

use anyhow::{Context, ensure};
use canopen_stm32f4::chip;
use emulator::chip::Part;

use testkit::{
    cargo::{cargo, workspace},
    product::Product,
};

use crate::controller;

/// Make a product: a package of its own, with its identity, objects, pins and tests
///
/// The product takes the protocol and the drivers from this repository, and has its own src/device.rs,
/// src/application.rs, src/pins.rs and the tasks in src/main.rs. Its tests run its release image on an emulated board.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// The name of the product, such as `lamp` or `door-lock`
    name: String,
    /// Its folder, which must not exist, outside of this repository [default: beside this repository]
    #[arg(long, value_name = "DIR")]
    path: Option<PathBuf>,
    /// Take this repository from there, not from this folder
    #[arg(long, value_name = "URL", value_parser = git_url)]
    git: Option<String>,
    /// The chip of the board
    #[arg(long, default_value = testkit::image::PART.name())]
    chip: Part,
    /// The CAN controller: can1, can2, or on some chips can3
    #[arg(long, default_value = "can1", value_parser = chip::controller)]
    controller: u8,
    /// With a loader, so that the program can be replaced over the bus
    #[arg(long)]
    update: bool,
    /// With a loader that takes only programs signed by the owner of a key
    #[arg(long, conflicts_with = "update")]
    signed: bool,
}

/// Makes the product, and prints what to do with it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments { name, path, git, chip, controller, update, signed } = arguments;
    check_name(name)?;
    controller::check(*chip, *controller)?;
    let workspace = workspace();
    let folder = match path {
        Some(path) => env::current_dir()?.join(path),
        None => workspace.parent().context("this repository is the root")?.join(name),
    };
    let folder = without_dots(&folder);
    ensure!(
        !folder.starts_with(workspace),
        "{} lies within this repository: give another folder with `--path`",
        folder.display()
    );
    ensure!(
        !folder.exists(),
        "{} exists: remove it, or give another folder with `--path`",
        folder.display()
    );
    let git = git.as_deref();
    let (chip, controller, is_signed) = (*chip, *controller, *signed);
    let has_update = *update || is_signed;
    Product { name, chip, controller, git, folder: &folder, has_update, is_signed }
        .write()
        .with_context(|| format!("cannot write {}", folder.display()))?;
    // The lines of the product's names have other lengths. Without rustfmt they stay as they are.
    quietly(cargo().arg("fmt"), &folder);
    println!("The product `{name}` is in {}:\n", folder.display());
    println!("    cd {}\n    cargo test\n", folder.display());
    println!("runs it on an emulated board. Its README.md says how to go on.");
    begin_history(&folder);
    Ok(())
}

/// Makes the folder a git repository, unless it lies in one or there is no git.
fn begin_history(folder: &Path) {
    if !quietly(Command::new("git").arg("rev-parse"), folder) {
        quietly(Command::new("git").args(["init", "--quiet"]), folder);
    }
}

/// Whether the command succeeds.
fn quietly(command: &mut Command, folder: &Path) -> bool {
    command.current_dir(folder).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.status().is_ok_and(|status| status.success())
}

/// Names that the product cannot have: of crates and modules in its program, and of the test harness.
const TAKEN: &str = "alloc app bxcan canopen-stm32f4 chip-build core cortex-m cortex-m-rt defmt defmt-rtt embedded-storage emulator flash \
    fugit canopen-node lss-slave panic-probe rtic std stm32f4xx-hal test testkit";

/// A URL of git that cargo takes, and that needs no escape in a manifest.
fn git_url(text: &str) -> Result<String, &'static str> {
    let is_of_url = |c: char| c.is_ascii_graphic() && !"\"<>\\^`{|}".contains(c);
    match text.split_once("://") {
        Some(("file" | "git" | "http" | "https" | "ssh", rest))
            if !rest.is_empty() && rest.chars().all(is_of_url) =>
        {
            Ok(text.to_owned())
        }
        _ => Err("give a URL such as https://example.org/lss-slave.git"),
    }
}

/// Checks that cargo and the compiler accept the name.
fn check_name(name: &str) -> anyhow::Result<()> {
    let is_of_name = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
    ensure!(
        name.starts_with(|c: char| c.is_ascii_lowercase())
            && name.chars().all(is_of_name)
            && !name.ends_with('-'),
        "`{name}` cannot be the name of a product: it must begin with one of the letters a to z, and go on with such \
         letters, digits and hyphens, as in `door-lock`"
    );
    ensure!(
        !TAKEN.split(' ').any(|taken| taken == name)
            && syn::parse_str::<syn::Ident>(&name.replace('-', "_")).is_ok(),
        "`{name}` cannot be the name of a product, because Rust or something in its program has that name"
    );
    Ok(())
}

/// `path` without `.` and `..`.
fn without_dots(path: &Path) -> PathBuf {
    path.components().fold(PathBuf::new(), |mut path, component| {
        match component {
            Component::CurDir => {}
            Component::ParentDir => {
                path.pop();
            }
            other => path.push(other),
        }
        path
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_that_cargo_and_the_compiler_accept_are_taken() {
        for name in ["lamp", "door-lock", "io4"] {
            check_name(name).expect(name);
        }
        for name in
            ["", "Lamp", "4io", "-lamp", "lamp-", "door_lock", "a/b", "fn", "core", "testkit"]
        {
            let error = check_name(name).expect_err(name).to_string();
            assert!(error.starts_with(&format!("`{name}` cannot be the name")), "{error}");
        }
    }

    #[test]
    fn only_urls_that_cargo_accepts_are_taken() {
        for url in ["https://example.org/a.git", "ssh://git@example.org:22/~a/b", "file:///a/b"] {
            assert_eq!(git_url(url).as_deref(), Ok(url));
        }
        for url in [
            "",
            "notaurl\"x",
            "https://",
            "https://a/\"x",
            "https://a/b c",
            "https://a/\u{e4}",
            "a/b.git",
            "git@example.org:a/b.git",
            "lamp://a/b",
        ] {
            git_url(url).expect_err(url);
        }
    }
}
