//! `cargo xtask release`: the files of a release, in a folder for each chip.

mod elsewhere;
mod image;
mod update;

use std::{
    fs,
    path::{Path, PathBuf},
};

use anyhow::{Context, ensure};
use emulator::{chip::Part, image::Image};
use sha2::{Digest, Sha256};
use testkit::cargo::workspace;

use crate::{eds, size};
pub(crate) use image::read_hex;

/// Write the files of a release, a folder for each chip
///
///   lss-slave.elf            the program with its debug information, for probe-rs, OpenOCD, STM32CubeProgrammer
///   lss-slave.hex            the program, for STM32CubeProgrammer and others
///   lss-slave-ADDRESS.bin    the parts of the program before and after the settings, for dfu-util and others
///   lss-slave.eds            the electronic data sheet
///   size.txt                 the memory that the program takes
///   SHA256SUMS               the checksums of these files
///
/// No file has a byte for the settings in sectors 1 and 2 of the flash. All are the same bytes wherever they are made:
/// docs/product.md, "Write the image".
///
/// With --update the program can be replaced over the bus, as that of a product with a loader: docs/update.md
///
///   factory.hex              loader and program, for a board that has none
///   loader.hex               the loader alone
///   lss-node.update.bin      the program, for `lss update` and other clients
///   lely.yml                 the two lines of it for the master of Lely
///   lss-node.eds, SHA256SUMS
///
/// A loader that takes only signed programs has your key: make a product with --signed, whose `cargo update-file --key
/// PEM` writes these files.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// Only these chips
    chips: Vec<Part>,
    /// The folder for the folders [default: target/release-kit in this repository]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Also build each program in another folder with another registry of cargo, and compare
    #[arg(long)]
    check_reproducible: bool,
    /// A program that can be replaced over the bus, and its loader
    #[arg(long, conflicts_with = "check_reproducible")]
    update: bool,
}

/// Writes the files.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let chips = if arguments.chips.is_empty() { &Part::F4[..] } else { &arguments.chips };
    for &chip in chips {
        let write = if arguments.update { update::write } else { write };
        write(chip, arguments).with_context(|| chip.name().to_owned())?;
    }
    Ok(())
}

fn write(chip: Part, arguments: &Arguments) -> anyhow::Result<()> {
    let elf = testkit::image::build_release(workspace(), None, chip)?;
    if arguments.check_reproducible {
        elsewhere::check(chip, &elf)?;
    }
    let (size, _) = size::report(&elf, chip, false)?;
    let image = Image::from_elf(&elf)?;
    let bytes: usize = image.segments().map(|(_, bytes)| bytes.len()).sum();
    ensure!(bytes > 0, "the program is empty");
    let mut files = image::files(&image)?;
    files.extend([
        ("lss-slave.eds".to_owned(), eds::of_firmware().eds().into_bytes()),
        ("size.txt".to_owned(), size.into_bytes()),
        ("lss-slave.elf".to_owned(), elf),
    ]);
    let folder = arguments.folder(chip.name());
    write_with_sums(&folder, files)?;
    println!("{}: {bytes} bytes of program", folder.display());
    Ok(())
}

impl Arguments {
    /// The folder of this name.
    fn folder(&self, name: &str) -> PathBuf {
        let usual = || workspace().join("target/release-kit");
        self.out.clone().unwrap_or_else(usual).join(name)
    }
}

/// Writes files and their checksums into a folder.
fn write_with_sums(folder: &Path, mut files: Vec<(String, Vec<u8>)>) -> anyhow::Result<()> {
    files.sort();
    let sums = files.iter().map(|(name, content)| format!("{}  {name}\n", sha256(content)));
    let sums = sums.collect::<String>();
    files.push(("SHA256SUMS".to_owned(), sums.into_bytes()));
    fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
    for (name, content) in files {
        let path = folder.join(name);
        fs::write(&path, content).with_context(|| format!("cannot write {}", path.display()))?;
    }
    Ok(())
}

/// The SHA-256 checksum in hexadecimal digits.
fn sha256(content: &[u8]) -> String {
    Sha256::digest(content).iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_is_that_of_fips_180() {
        let expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(sha256(b"abc"), expected);
    }
}
