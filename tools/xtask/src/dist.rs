//! `cargo xtask dist`: the files of a release, as the page of a release offers them.

mod lss;
mod update;

use std::{fs, path::PathBuf};

use anyhow::{Context, ensure};
use emulator::{chip::Part, image::Image};
use testkit::{
    cargo::workspace,
    eds::ours,
    release::{self, Program},
};

/// Write the files of a release into target/dist
///
///   lss-TARGET/              the program `lss` for computers of this kind, with the licences of what it contains
///   CHIP/                    the firmware, which CAN does not change:
///     lss-slave.elf          the program with its debug information, for probe-rs, OpenOCD, STM32CubeProgrammer
///     lss-slave.hex          the program, for STM32CubeProgrammer and others
///     lss-slave-ADDRESS.bin  the parts of the program before and after the settings, for dfu-util and others
///     lss-slave.eds          the electronic data sheet
///     size.txt               the memory that the program takes
///   CHIP-update/             the same firmware with a loader, which takes another one over the bus: docs/update.md
///     factory.hex            loader and program, for a board that has none
///     loader.hex             the loader alone
///     lss-node.update.bin    the program, for `lss update` and other clients
///     lely.yml               the two lines of it for the master of Lely
///     lss-node.eds           the electronic data sheet
///
/// Each folder has the checksums of its files, SHA256SUMS. No file has a byte for the settings in sectors 1 and 2 of
/// the flash. The images are the same bytes wherever they are made: docs/product.md, "Write the image".
///
/// On Linux it makes `lss` for Linux on x86-64 and ARM64, and for Windows if the linker of MinGW is there; on macOS for
/// both of its processors; on Windows for Windows.
///
/// A loader that takes only signed programs has your key: make a product with --signed, whose `cargo update-file --key
/// PEM` writes these files.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// Only the images of these chips
    chips: Vec<Part>,
    /// Only the program `lss`
    #[arg(long, conflicts_with_all = ["chips", "images"])]
    lss: bool,
    /// Only the images, of all chips
    #[arg(long, conflicts_with = "chips")]
    images: bool,
    /// The folder for the folders [default: target/dist in this repository]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Also build each image in another folder with another registry of cargo, and compare
    #[arg(long)]
    check_reproducible: bool,
}

/// Writes the files.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let is_whole = arguments.chips.is_empty();
    if is_whole {
        let manifest = fs::read_to_string(workspace().join("Cargo.toml")).context("Cargo.toml")?;
        check_repository(&manifest)?;
    }
    if is_whole && !arguments.images {
        lss::write(arguments)?;
    }
    let chips = if is_whole { &Part::F4[..] } else { &arguments.chips };
    for &chip in chips.iter().filter(|_| !arguments.lss) {
        write(chip, arguments).with_context(|| chip.name().to_owned())?;
        update::write(chip, arguments).with_context(|| format!("{}, update", chip.name()))?;
    }
    Ok(())
}

/// A release names the repository that it is made from: crates and pages link to it.
fn check_repository(manifest: &str) -> anyhow::Result<()> {
    let manifest: toml::Table = manifest.parse().context("Cargo.toml")?;
    let repository = manifest["workspace"]["package"].get("repository");
    ensure!(
        repository.and_then(|url| url.as_str()).is_some_and(|url| url.starts_with("https://")),
        "nobody could find where this release comes from: write the address of your repository into Cargo.toml, \
         [workspace.package], as in `repository = \"https://example.org/lss-slave\"`"
    );
    Ok(())
}

fn write(chip: Part, arguments: &Arguments) -> anyhow::Result<()> {
    let program = Program {
        folder: workspace(),
        package: "firmware",
        part: chip,
        name: "lss-slave",
        data_sheet: ours::of_firmware().eds(),
    };
    let files = program.files()?;
    if arguments.check_reproducible {
        let segments = |image: &Image| -> Vec<(u32, Vec<u8>)> {
            image.segments().map(|(address, bytes)| (address, bytes.to_vec())).collect()
        };
        let (_, elf) =
            files.iter().find(|(name, _)| name.ends_with(".elf")).expect("it is one of them");
        ensure!(
            segments(&testkit::image::build(chip)?) == segments(&Image::from_elf(elf)?),
            "the program is not the one that the tests run"
        );
        // The name has another length than the usual one.
        program.check_reproducible(&workspace().join("target/elsewhere/a-copy-of-the-sources"))?;
    }
    release::write(&arguments.folder(chip.name()), files)
}

impl Arguments {
    /// The folder of this name.
    fn folder(&self, name: &str) -> PathBuf {
        self.out.clone().unwrap_or_else(|| workspace().join("target/dist")).join(name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_release_names_its_repository() {
        let manifest = |line| format!("[workspace.package]\n{line}\n");
        for line in ["", "repository = \"\"", "repository = \"lss-slave\""] {
            let error = check_repository(&manifest(line)).expect_err(line).to_string();
            assert!(
                error.contains("Cargo.toml, [workspace.package], as in `repository = "),
                "{error}"
            );
        }
        check_repository(&manifest("repository = \"https://example.org/lss-slave\""))
            .expect("it does");
    }
}
