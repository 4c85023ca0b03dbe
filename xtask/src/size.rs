//! `cargo xtask size`: how much flash and RAM the firmware takes, against the budget in `size-budget.toml`.

use std::{env, fs, path::PathBuf};

use anyhow::{Context, bail};
use emulator::{
    chip::{FLASH_BASE, Part, RAM_BASE},
    image::Image,
};
use object::{Object, ObjectSection, SectionFlags, elf, read::elf::ElfFile32};

use crate::boards;

/// Show the memory that the firmware takes, and check it against the budget
#[derive(clap::Args)]
pub struct Arguments {
    /// The chip to build for
    #[arg(long, default_value = "stm32f405", value_parser = boards::part())]
    chip: Part,
}

/// A section of the program that takes memory.
struct Section {
    name: String,
    bytes: u64,
    in_flash: bool,
    in_ram: bool,
}

/// Prints the sizes. Fails if they are above the budget.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    Image::build(arguments.chip)?;
    let path = elf_path()?;
    let elf = fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
    let sections = sections(&elf).with_context(|| format!("cannot parse {}", path.display()))?;
    let sum = |of: fn(&&Section) -> bool| -> u64 {
        sections.iter().filter(of).map(|section| section.bytes).sum()
    };
    let (flash, ram) = (sum(|section| section.in_flash), sum(|section| section.in_ram));
    let budget = budget();

    println!("{:16} {:>8} {:>8}", arguments.chip.name(), "flash", "RAM");
    for Section { name, bytes, in_flash, in_ram } in &sections {
        let column = |takes: &bool| if *takes { bytes.to_string() } else { String::new() };
        println!("{name:16} {:>8} {:>8}", column(in_flash), column(in_ram));
    }
    println!("{:16} {flash:>8} {ram:>8}", "total");
    println!("{:16} {budget:>8}", "budget");
    if flash > budget {
        bail!(
            "the firmware takes {} bytes more flash than size-budget.toml allows",
            flash - budget
        );
    }
    Ok(())
}

/// Bytes of flash that the firmware may take.
fn budget() -> u64 {
    let budget: toml::Table =
        include_str!("../size-budget.toml").parse().expect("size-budget.toml is TOML");
    let flash = budget["flash"].as_integer().expect("size-budget.toml gives flash in bytes");
    flash.try_into().expect("the budget is not negative")
}

/// The firmware lies beside this program: both are built by one cargo into one directory.
fn elf_path() -> anyhow::Result<PathBuf> {
    let own = env::current_exe()?;
    let target = own.ancestors().nth(2).context("this program is not in a target directory")?;
    Ok(target.join("thumbv7em-none-eabihf/release/lss-slave"))
}

/// The sections that are not empty, in the order of the file.
fn sections(elf: &[u8]) -> object::Result<Vec<Section>> {
    let file = ElfFile32::<object::Endianness>::parse(elf)?;
    let is_allocated = |flags| match flags {
        SectionFlags::Elf { sh_flags } => sh_flags & u64::from(elf::SHF_ALLOC) != 0,
        _ => false,
    };
    let mut sections = Vec::new();
    for section in file.sections() {
        if section.size() == 0 || !is_allocated(section.flags()) {
            continue;
        }
        let in_ram = section.address() >= u64::from(RAM_BASE);
        sections.push(Section {
            name: section.name()?.to_owned(),
            bytes: section.size(),
            in_flash: section.address() >= u64::from(FLASH_BASE) && section.file_range().is_some(),
            in_ram,
        });
    }
    Ok(sections)
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_budget_is_readable() {
        assert!(super::budget() > 0);
    }
}
