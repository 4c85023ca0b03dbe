//! The files of a release of a program: for programmers of all kinds, with its data sheet, its size and their checksums.

mod elsewhere;
mod parts;

use std::{
    env, fs,
    path::{Path, PathBuf},
    process::ExitCode,
};

use anyhow::{Context, bail};
use emulator::{chip::Part, image::Image};
use sha2::{Digest, Sha256};

pub use parts::read_hex;

use crate::{elf, image};

const HELP: &str = "\
Usage: cargo release-files [--check-reproducible] [FOLDER]

Writes the files of a release into target/release-files, or another folder: for each programmer of chips the program,
its data sheet, its size, and the checksums of all.
--check-reproducible also builds the program in a copy beside this folder, with another registry of cargo, and fails if
a byte differs. The copy stays, so that the next check is faster.";

/// A file: its name and its content.
pub type File = (String, Vec<u8>);

/// A program to be released.
pub struct Program<'a> {
    /// The folder of its package.
    pub folder: &'a Path,
    /// The name of the package, and of the program.
    pub package: &'a str,
    pub part: Part,
    /// The name of the files.
    pub name: &'a str,
    /// The content of its electronic data sheet.
    pub data_sheet: String,
}

impl Program<'_> {
    /// Builds the program, and returns its files:
    /// - `NAME.elf`, the program with its debug information;
    /// - `NAME.hex`, and `NAME-ADDRESS.bin` for each part of it that lies before or after the settings;
    /// - `NAME.eds` and `size.txt`.
    ///
    /// None of the files has a byte for the settings.
    ///
    /// # Errors
    /// It does not build, or has a byte for the settings.
    pub fn files(&self) -> anyhow::Result<Vec<File>> {
        let elf = self.elf(self.folder, None)?;
        let (size, _) = elf::size(&elf, self.part)?;
        let mut files = parts::files(&Image::from_elf(&elf)?, self.name)?;
        files.extend([
            (format!("{}.eds", self.name), self.data_sheet.clone().into_bytes()),
            ("size.txt".to_owned(), size.into_bytes()),
            (format!("{}.elf", self.name), elf),
        ]);
        Ok(files)
    }

    /// Checks that the program is the same bytes if a copy of the folder, at `copy`, is built with another registry.
    ///
    /// # Errors
    /// It is not, with the sections that differ.
    pub fn check_reproducible(&self, copy: &Path) -> anyhow::Result<()> {
        elsewhere::check(self, copy)
    }

    fn elf(&self, folder: &Path, cargo_home: Option<&Path>) -> anyhow::Result<Vec<u8>> {
        image::build_release(folder, self.package, cargo_home, self.part)
    }
}

/// Writes files and their checksums into a folder, which may have others.
///
/// # Errors
/// The folder cannot be written.
pub fn write(folder: &Path, mut files: Vec<File>) -> anyhow::Result<()> {
    files.sort();
    let sums = files.iter().map(|(name, content)| {
        let sum: String =
            Sha256::digest(content).iter().map(|byte| format!("{byte:02x}")).collect();
        format!("{sum}  {name}\n")
    });
    let sums = sums.collect::<String>();
    files.push(("SHA256SUMS".to_owned(), sums.into_bytes()));
    let cannot = || format!("cannot write {}", folder.display());
    fs::create_dir_all(folder).with_context(cannot)?;
    for (name, content) in files {
        fs::write(folder.join(name), content).with_context(cannot)?;
    }
    println!("{}", folder.display());
    Ok(())
}

/// `cargo release-files [--check-reproducible] [FOLDER]` of the product `name` in `product`: writes its files into
/// `target/release-files`, or another folder. Prints why it fails.
pub fn run(product: &Path, name: &str, data_sheet: String) -> ExitCode {
    match try_run(product, name, data_sheet) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn try_run(product: &Path, name: &str, data_sheet: String) -> anyhow::Result<()> {
    let (mut is_checked, mut folder) = (false, None);
    for argument in env::args().skip(1) {
        match &*argument {
            "--check-reproducible" => is_checked = true,
            "--help" | "-h" => {
                println!("{HELP}");
                return Ok(());
            }
            other if !other.starts_with('-') && folder.is_none() => {
                folder = Some(PathBuf::from(other));
            }
            other => bail!("unknown argument {other}; see `cargo release-files --help`"),
        }
    }
    let (part, _) = image::board_of(product)?;
    let program = Program { folder: product, package: name, part, name, data_sheet };
    let files = program.files()?;
    if is_checked {
        program.check_reproducible(&product.with_file_name(format!("{name}-elsewhere")))?;
    }
    write(&folder.unwrap_or_else(|| product.join("target/release-files")), files)
}
